"""From a mesh to a prepared object: repair, hulls, fields, quality filters, manifests."""
