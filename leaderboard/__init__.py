"""Metrics, submissions, scoring, ranking, pictures and the page. Imports no simulator and no torch."""
