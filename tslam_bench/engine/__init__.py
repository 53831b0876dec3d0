"""Simulation, sensing and rewards of many hands; the vector environments."""
