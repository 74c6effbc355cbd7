"""What robots recorded in episodes: pictures with their times, joint positions with theirs."""
