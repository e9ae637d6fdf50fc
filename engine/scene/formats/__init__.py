"""Camera files: COLMAP models, nerfstudio's transforms.json and a result's cameras.json."""
