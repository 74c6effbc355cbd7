"""`drake-pose register` and `drake-pose audit`: camera poses from a robot at known positions."""
