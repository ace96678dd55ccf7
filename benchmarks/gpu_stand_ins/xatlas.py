"""An empty xatlas: imported by nerfstudio's exporter for textures, which this project does not export."""
