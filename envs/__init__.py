"""Environments that show the policy what the others are about to do: readers, wrappers, collection, evaluation."""
