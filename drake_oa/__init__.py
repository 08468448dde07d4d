"""Reactive obstacle avoidance as Drake systems (Pairet et al., RA-L 2019)."""

from pathlib import Path as _Path

from drake_oa.common.kernel_cache import provide_kernel_cache as _provide_kernel_cache

# Before any module that compiles is imported.
_KERNEL_CACHE = _provide_kernel_cache(_Path(__file__).parent)
