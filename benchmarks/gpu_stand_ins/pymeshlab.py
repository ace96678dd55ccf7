"""Nothing: nerfstudio's exporter imports this package for meshes, and no mesh is exported here."""
