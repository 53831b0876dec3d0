"""Meshes, fields and rays: mathematics that knows nothing of the benchmark."""
