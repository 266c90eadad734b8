"""Foreign files and logs as the array that the estimator takes."""
