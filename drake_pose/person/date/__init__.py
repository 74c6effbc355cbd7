"""The method of Date, Yoshimatsu, Arita and Taniguchi (2004): a person's pose by many cameras."""
