"""A measured log beside the predictions of models."""
