"""Small scenes, captures, pipelines and networks with known truth, from which tests are built."""
