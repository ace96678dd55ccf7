"""An empty PyMeshLab: imported by nerfstudio's exporter for meshes, which this project does not export."""
