"""A measured log, prepared, beside the model that a vector of unknowns gives."""
