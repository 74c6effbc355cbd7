"""Linear inequalities, and the part of a normal distribution inside them."""
