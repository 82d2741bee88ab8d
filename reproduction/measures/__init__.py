"""What the paper and the tables measure of data, plans, codes and predictions."""
