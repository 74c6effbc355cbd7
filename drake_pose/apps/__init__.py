"""The command line, and whole jobs in one call. Nothing heavy is imported here."""
