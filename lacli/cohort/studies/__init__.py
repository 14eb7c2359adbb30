"""Questions that the published study asks of its own method: does thickness matter, does the law of Laplace hold?"""
