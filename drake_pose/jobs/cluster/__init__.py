"""Workers on this machine or on others: scheduler, processes, and the cameras they watch."""
