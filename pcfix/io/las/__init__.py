"""LAS and LAZ: read chunk by chunk, write chunk by chunk, and lose nothing in between."""
