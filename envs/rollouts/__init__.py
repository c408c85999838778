"""Episodes of running environments, played for collection and evaluation."""
