"""The compiled mechanics. Nothing here knows robots, files or effects; only arrays and numbers."""
