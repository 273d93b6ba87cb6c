"""A robot that is driven from a page: controls, session, limits."""
