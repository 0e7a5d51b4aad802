"""The default estimator: lanes as ridges of traffic density in road coordinates, step by step."""
