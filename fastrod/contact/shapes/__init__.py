"""The shapes that come with it: one a file, registered by its import."""
