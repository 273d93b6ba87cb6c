"""fastrod: tendon-driven continuum robots, simulated in batches and corrected by measured data."""
