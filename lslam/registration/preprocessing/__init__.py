"""Preparing a scan: range gate and down-sampling."""
