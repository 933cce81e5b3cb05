"""Loosely coupled IMU: it predicts, registration corrects."""
