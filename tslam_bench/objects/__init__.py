"""Prepared objects and the converted hand on disk: what tasks, training and scoring read."""
