"""Generated household shapes: solids, kinds of things, and the order in which they are drawn."""
