"""What the documents claim: measurements with commit, date and machine, and the tables made from them."""
