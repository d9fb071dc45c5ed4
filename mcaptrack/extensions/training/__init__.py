"""Training of predictors: synthetic walks or recorded tracks in, weights out. Only this package imports torch."""
