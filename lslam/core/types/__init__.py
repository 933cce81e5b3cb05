"""The values that flow through lslam: plain frozen data, no behaviour beyond checking shapes."""
