"""Where a fit begins: coarse search, root placement, limbs placed anew, other turns."""
