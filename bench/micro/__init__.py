"""Micro benchmarks of the parts of zstate: ``python -m bench.micro`` lists them."""
