from ._call import Ensemble, ensemble
