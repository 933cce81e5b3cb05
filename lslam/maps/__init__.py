"""The merged map."""
