"""The ablation ladder: which stage of the chain loses which fruit."""
