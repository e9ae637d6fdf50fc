"""Training and fitting of the weights that the package ships."""
