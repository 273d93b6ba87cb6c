"""Physical effects: what one is (`base`), where it acts (`ports`), all those of a robot (`pipeline`), and the
laws."""
