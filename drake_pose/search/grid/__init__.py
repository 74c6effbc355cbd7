"""Searches on a grid of joint values: beam search, branch and bound, families of equal poses."""
