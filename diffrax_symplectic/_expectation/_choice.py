"""Which sampling to take, by a short pilot."""


def chosen(problem, weights, key, tol, devices):
    raise NotImplementedError
