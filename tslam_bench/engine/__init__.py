"""Simulation, sensing and rewards of many hands; the vector environments."""

import warnings

# Said at the first import of sapien on a machine without Vulkan, which only rendering needs.
warnings.filterwarnings("ignore", message="Failed to find system libvulkan")
