"""Where meshes come from: wheels, files of the user, the generator."""
