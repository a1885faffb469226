"""The camera: its lens both ways, its frame, its attitude."""
