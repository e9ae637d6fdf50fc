"""Published counting methods, for comparison: the paper's templates and FruitNeRF's clustering."""
