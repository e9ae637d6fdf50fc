"""Where fruit are counted: region of interest, trees of a row, ground."""
