"""Summaries, figures and the HTML page."""
