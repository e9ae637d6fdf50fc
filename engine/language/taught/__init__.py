"""Words that users taught: their names, their files, and the answer that they give."""
