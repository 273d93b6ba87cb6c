"""Training, policies and their evaluation."""
