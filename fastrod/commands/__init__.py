"""The `fastrod` command. Nothing imports it."""
