class Identification:
    pass


def identify(*a): ...
