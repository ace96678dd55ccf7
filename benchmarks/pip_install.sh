#!/usr/bin/env bash
# Try the installation with pip that docs/quickstart.md describes, in an environment of its own that is removed after.
#
#     benchmarks/pip_install.sh [PYTHON]
#
# Prints the seconds that pip took, the packages that hold a cv2 (there must be one), and whether all that is heavy
# imports. The packages take about 8 GB while it runs.
set -euo pipefail
python=${1:-python3}
repository=$(cd "$(dirname "$0")/.." && pwd)
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"$python" -m venv "$folder/environment"
SECONDS=0
(cd "$repository" && "$folder/environment/bin/pip" install --quiet --no-cache-dir --no-deps -r constraints.txt .)
echo "pip install: $SECONDS s, $(du -sh "$folder/environment" | cut -f1), $("$folder/environment/bin/python" --version)"
cd "$folder"
environment/bin/python - <<'CHECK'
from importlib.metadata import distributions

owners = [d.name for d in distributions() if any(str(f) == "cv2/__init__.py" for f in d.files or ())]
print("cv2 comes from:", ", ".join(owners))
assert owners == ["opencv-contrib-python-headless"], owners
import cv2
import nerfstudio.scripts.exporter
import open3d
import pycolmap
import spectral
import torch
import torchvision

cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_50))
print("imports:", *(f"{m.__name__} {m.__version__}" for m in (cv2, open3d, pycolmap, spectral, torch, torchvision)))
CHECK
environment/bin/hsi-sc-nerf --help > help.txt
environment/bin/ns-train hsi-sc-nerf --help > help.txt
environment/bin/tensorboard --version > help.txt
echo "hsi-sc-nerf, ns-train hsi-sc-nerf and tensorboard start."
