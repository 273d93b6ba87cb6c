"""Physical effects: what one is (`base`), where it acts (`ports`), what runs them (`executor`), all those of
a robot (`pipeline`), and the laws."""
