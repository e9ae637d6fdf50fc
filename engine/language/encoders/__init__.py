"""Encoders of photos and words: the embedded network, CLIP and SigLIP."""
