"""Training of predictors: made-up walks or recorded tracks in, weights out. The only place that knows torch."""
