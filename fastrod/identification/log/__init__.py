"""What was measured: a log, prepared, beside the model that a vector of unknowns gives."""
