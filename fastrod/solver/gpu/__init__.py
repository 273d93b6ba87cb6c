"""The batch on a GPU: the kernels of `fastrod.kernels` compiled once more, by numba.cuda, one thread a robot.

numba.cuda is imported only where a simulator is made for it.
"""
