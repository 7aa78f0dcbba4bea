"""Small scenes, captures, pipelines and networks, on which the tests run; the correct results are known."""
