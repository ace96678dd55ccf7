"""Nothing: nerfstudio's exporter imports this package for textures, and no texture is exported here."""
