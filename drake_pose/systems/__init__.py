"""The estimators as Drake systems, and ready diagrams of them."""
