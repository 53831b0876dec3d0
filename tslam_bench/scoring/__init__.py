"""Submissions, metrics and scores; imports neither torch nor a simulator."""
