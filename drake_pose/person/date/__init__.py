"""Date, Yoshimatsu, Arita and Taniguchi's way from the pictures of many cameras to a pose."""
