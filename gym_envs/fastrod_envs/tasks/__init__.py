"""The ten tasks, one a file; the robots they share with the scenes come from there."""
