"""How far a cloud is from a reference."""
