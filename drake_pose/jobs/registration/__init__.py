"""`drake-pose register`: where cameras stand, from masks of a robot at known joint positions."""
