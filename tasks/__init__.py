"""The tactile exploration tasks: hand, sensing, rewards, ManiSkill environments."""
