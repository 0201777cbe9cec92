"""Rigidity: which motions of a shape the distances prevent, which remain free, and which other shapes they allow."""

from rigidfleet.math.constraint_jacobian import jacobian
from rigidfleet.rigidity.analysis import Rigidity, RigidityClass, analyse, full_rank
from rigidfleet.rigidity.framework import Flex, rigid_motions
from rigidfleet.rigidity.realisations import Kind, Realisation, Realisations, realisations
from rigidfleet.rigidity.spectrum import Spectrum, spectrum

__all__ = [
    "Flex",
    "Kind",
    "Realisation",
    "Realisations",
    "Rigidity",
    "RigidityClass",
    "Spectrum",
    "analyse",
    "full_rank",
    "jacobian",
    "realisations",
    "rigid_motions",
    "spectrum",
]
