"""The paper's tables and figures, and the confusion matrix of hidden effects."""
