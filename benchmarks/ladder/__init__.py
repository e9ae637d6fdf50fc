"""The ablation ladder: which stage of the pipeline loses which fruit."""
