"""Beam search: hypotheses grow node by node, the most promising are kept."""
