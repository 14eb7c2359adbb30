"""What the comparison of models is made of: their evidence, regions about a level, runs where a model is likely."""
