"""Policies, rollouts, evaluations and jobs."""
