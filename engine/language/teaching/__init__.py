"""Teaching words: what a click shows, and what is learnt from examples."""
