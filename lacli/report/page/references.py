"""What a methods paragraph cites, as BibTeX."""

from __future__ import annotations

from collections.abc import Iterable


def _article(key: str, author: str, title: str, journal: str, year: int, where: str, doi: str) -> str:
    fields = {"author": author, "title": f"{{{title}}}", "journal": journal, "year": str(year), "pages": where, "doi": doi}
    return f"@article{{{key},\n" + ",\n".join(f"  {name} = {{{value}}}" for name, value in fields.items() if value) + "\n}"


_ENTRIES = {
    "Hecht2012": (
        "Hecht, F.", "New development in FreeFem++", "Journal of Numerical Mathematics", 2012, "251--265",
        "10.1515/jnum-2012-0013",
    ),
    "Guccione1991": (
        "Guccione, J. M. and McCulloch, A. D. and Waldman, L. K.",
        "Passive material properties of intact ventricular myocardium determined from a cylindrical model",
        "Journal of Biomechanical Engineering", 1991, "42--55", "10.1115/1.2894084",
    ),
    "Roney2019": (
        "Roney, C. H. and others",
        "Universal atrial coordinates applied to visualisation, registration and construction of patient specific meshes",
        "Medical Image Analysis", 2019, "65--75", "10.1016/j.media.2019.04.004",
    ),
    "Bols2013": (
        "Bols, J. and others",
        "A computational method to assess the in vivo stresses and unloaded configuration of patient-specific blood vessels",
        "Journal of Computational and Applied Mathematics", 2013, "10--17", "10.1016/j.cam.2012.10.034",
    ),
    "Vernon2010": (
        "Vernon, I. and Goldstein, M. and Bower, R. G.", "Galaxy formation: a Bayesian uncertainty analysis",
        "Bayesian Analysis", 2010, "619--669", "10.1214/10-BA524",
    ),
    "ForemanMackey2013": (
        "Foreman-Mackey, D. and Hogg, D. W. and Lang, D. and Goodman, J.", "emcee: The MCMC Hammer",
        "Publications of the Astronomical Society of the Pacific", 2013, "306--312", "10.1086/670067",
    ),
    "Marquardt1963": (
        "Marquardt, D. W.", "An algorithm for least-squares estimation of nonlinear parameters",
        "Journal of the Society for Industrial and Applied Mathematics", 1963, "431--441", "10.1137/0111030",
    ),
    "Kennedy2000": (
        "Kennedy, M. C. and O'Hagan, A.",
        "Predicting the output from a complex computer code when fast approximations are available", "Biometrika", 2000,
        "1--13", "10.1093/biomet/87.1.1",
    ),
    "Morris1993": (
        "Morris, M. D. and Mitchell, T. J. and Ylvisaker, D.",
        "Bayesian design and analysis of computer experiments: use of derivatives in surface prediction", "Technometrics", 1993,
        "243--255", "10.1080/00401706.1993.10485320",
    ),
    "Holm1979": (
        "Holm, S.", "A simple sequentially rejective multiple test procedure", "Scandinavian Journal of Statistics", 1979,
        "65--70", "",
    ),
    "Lindstrom1988": (
        "Lindstrom, M. J. and Bates, D. M.",
        "Newton-Raphson and EM algorithms for linear mixed-effects models for repeated-measures data",
        "Journal of the American Statistical Association", 1988, "1014--1022", "10.1080/01621459.1988.10478693",
    ),
    "Firth1993": (
        "Firth, D.", "Bias reduction of maximum likelihood estimates", "Biometrika", 1993, "27--38", "10.1093/biomet/80.1.27",
    ),
    "DelMoral2006": (
        "Del Moral, P. and Doucet, A. and Jasra, A.", "Sequential Monte Carlo samplers",
        "Journal of the Royal Statistical Society: Series B", 2006, "411--436", "10.1111/j.1467-9868.2006.00553.x",
    ),
    "Gelman2006": (
        "Gelman, A.", "Prior distributions for variance parameters in hierarchical models", "Bayesian Analysis", 2006,
        "515--534", "10.1214/06-BA117A",
    ),
    "Vehtari2017": (
        "Vehtari, A. and Gelman, A. and Gabry, J.",
        "Practical Bayesian model evaluation using leave-one-out cross-validation and WAIC", "Statistics and Computing", 2017,
        "1413--1432", "10.1007/s11222-016-9696-4",
    ),
}  # fmt: skip
SHORT = {
    "Hecht2012": "Hecht 2012",
    "Guccione1991": "Guccione et al. 1991",
    "Roney2019": "Roney et al. 2019",
    "Bols2013": "Bols et al. 2013",
    "Vernon2010": "Vernon et al. 2010",
    "ForemanMackey2013": "Foreman-Mackey et al. 2013",
    "Marquardt1963": "Marquardt 1963",
    "Kennedy2000": "Kennedy and O'Hagan 2000",
    "Morris1993": "Morris et al. 1993",
    "Holm1979": "Holm 1979",
    "Lindstrom1988": "Lindstrom and Bates 1988",
    "Firth1993": "Firth 1993",
    "DelMoral2006": "Del Moral et al. 2006",
    "Gelman2006": "Gelman 2006",
    "Vehtari2017": "Vehtari et al. 2017",
    "lacli": "lacli",
}


def bibtex(keys: Iterable[str], version: str) -> str:
    """The entries of these keys and of lacli itself, in this order."""
    own = f"@software{{lacli,\n  author = {{{{The lacli developers}}}},\n  title = {{lacli}},\n  version = {{{version}}}\n}}"
    return "\n\n".join([*(_article(key, *_ENTRIES[key]) for key in keys), own]) + "\n"
