"""Worlds that a page shows: free robots, scenes, hosts."""
