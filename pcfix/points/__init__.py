"""Points of a cloud: which are under water, which are noise, and their neighbours."""
