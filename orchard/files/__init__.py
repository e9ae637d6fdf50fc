"""Files of a finished scene: COLMAP model, transforms.json, PNG masks, truth."""
