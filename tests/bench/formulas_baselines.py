"""What general tools find in the residuals that the search for formulas sees.

    python -m tests.bench.formulas --keep TABLES …
    python -m tests.bench.formulas_baselines TABLES [--only gplearn,pygam] [-o FILE]

They are no part of the program and need not be installed: boosted trees with SHAP (``lightgbm``),
additive models (``pygam``), sparse identification (``pysindy``), symbolic regression (``gplearn``);
what is missing is skipped by name. PySR needs Julia. This file needs numpy, pandas and scipy alone,
so that it runs in an environment of its own.

Each takes the residuals of the first fit over all columns of the beams and stops, learns on two
thirds of the locations and is tested on the rest. A covariate counts as found where it is in the
formula, or has at least `SHARE` of the attribution. None is told of clusters.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from .formulas_effects import SAME, same
from .formulas_size import rms

SHARE = 0.1  # of the attribution, taken beforehand: ten covariates of no use would share it
CLIP = 6  # sigmas by the median, beyond which a residual is cut
SLOW_ROWS = 5000  # that the slow ones learn on
NO_COVARIATE = ("residual_m", "sigma_m", "weight", "count", "range_std_m", "error_m", *"xyz")
NO_COVARIATE += ("surface", "region", "patch", "plane", "normal_x", "normal_y", "normal_z")

Answer = tuple[list[str], np.ndarray]  # covariates, prediction (M,) for what was held back


@dataclass(frozen=True)
class Data:
    """Covariates (N, P) and (M, P), and residuals (N,) mm clipped, to learn on and to be tested;
    and the location (N,) of those to learn on."""

    names: list[str]
    learn: np.ndarray
    mm: np.ndarray
    place: np.ndarray
    test: np.ndarray
    test_mm: np.ndarray

    def few(self, most: int) -> tuple[np.ndarray, np.ndarray]:
        """Some of the rows to learn on."""
        some = np.random.default_rng(0).permutation(len(self.mm))[:most]
        return self.learn[some], self.mm[some]

    def sharing(self, share: np.ndarray) -> list[str]:
        """Covariates with at least `SHARE` of what (P,) attributes."""
        return [n for n, s in zip(self.names, share / share.sum(), strict=True) if s >= SHARE]


def data(table: pd.DataFrame) -> Data:
    """A table of the judge's, split by location; columns of no use left out, angles in rad, all
    others in standard deviations about their mean."""
    kept = [
        name
        for name in table.select_dtypes("number")
        if name not in NO_COVARIATE and name not in SAME and "markers.q" not in name
    ]
    columns = table[kept].astype(float)
    columns = columns.loc[:, columns.notna().all() & (columns.std() > 0)]
    scaled = (columns - columns.mean()) / columns.std()
    for name in columns:
        if name.endswith("_rad") or name.startswith("joint_"):
            scaled[name] = columns[name]
    mm = 1e3 * table["residual_m"].to_numpy(float)
    spread = 1.4826 * np.median(np.abs(mm - np.median(mm)))
    mm = np.clip(mm - np.median(mm), -CLIP * spread, CLIP * spread)
    place = pd.factorize(table["stop"].str[:3])[0]
    held, x = place % 3 == 2, scaled.to_numpy()
    return Data(
        names=list(scaled),
        learn=x[~held],
        mm=mm[~held],
        place=place[~held],
        test=x[held],
        test_mm=mm[held],
    )


def trees(data: Data) -> Answer:
    """Boosted trees; attribution by TreeSHAP."""
    import lightgbm

    model = lightgbm.LGBMRegressor(
        n_estimators=200, num_leaves=15, min_child_samples=100, n_jobs=1, verbose=-1
    )
    model.fit(data.learn, data.mm)
    shap = model.predict(data.test, pred_contrib=True)[:, :-1]
    return data.sharing(np.abs(shap).mean(axis=0)), model.predict(data.test)


def additive(data: Data) -> Answer:
    """A penalised spline of every covariate; attribution by its standard deviation."""
    from pygam import LinearGAM, s

    terms = s(0, n_splines=12)
    for i in range(1, len(data.names)):
        terms += s(i, n_splines=12)
    x, mm = data.few(4 * SLOW_ROWS)
    model = LinearGAM(terms, lam=10.0).fit(x, mm)
    test = np.clip(data.test, x.min(axis=0), x.max(axis=0))
    parts = [model.partial_dependence(term=i, X=test) for i in range(len(data.names))]
    return data.sharing(np.std(parts, axis=1)), model.predict(test)


def sparse(data: Data) -> Answer:
    """Sequentially thresholded least squares over products and waves of two covariates, as SINDy's;
    its threshold by one of the locations to learn on."""
    from pysindy import STLSQ

    library, uses = _library(data)
    held, x = data.place == data.place[0], library(data.learn)
    scale = x.std(axis=0)
    x = x / scale
    best, least = None, np.inf
    for threshold in (0.2, 0.4, 0.8, 1.6, 3.2):
        model = STLSQ(threshold=threshold, alpha=1e-3, max_iter=20)
        model.fit(x[~held], data.mm[~held, None])
        left = rms(data.mm[held] - x[held] @ model.coef_.ravel())
        if left < 0.999 * least or best is None:
            best, least = model.coef_.ravel(), left
    found = {name for k in np.flatnonzero(best) for name in uses[k]}
    return sorted(found), library(data.test) / scale @ best


def _library(data: Data) -> tuple[Callable[[np.ndarray], np.ndarray], list[tuple[str, ...]]]:
    """Functions of single covariates and their products by pairs, and what each looks at."""
    single = [(n, i, f) for i, n in enumerate(data.names) for f in _functions(n)]
    pairs = [(a, b) for k, a in enumerate(single) for b in single[:k] if a[1] != b[1]]

    def made(x: np.ndarray) -> np.ndarray:
        alone = [f(x[:, i]) for _, i, f in single]
        value = {(i, f): each for (_, i, f), each in zip(single, alone, strict=True)}
        both = [value[a[1:]] * value[b[1:]] for a, b in pairs]
        return np.column_stack([*alone, *both])

    return made, [*((n,) for n, _, _ in single), *((a[0], b[0]) for a, b in pairs)]


def _functions(name: str) -> tuple[Callable[[np.ndarray], np.ndarray], ...]:
    waves = name == "azimuth_rad" or name.startswith("joint_")
    return (np.sin, np.cos) if waves else (np.positive, np.square)


def symbolic(data: Data) -> Answer:
    """Symbolic regression by genetic programming."""
    from gplearn.genetic import SymbolicRegressor

    model = SymbolicRegressor(
        population_size=1000,
        generations=15,
        function_set=("add", "sub", "mul", "div", "sin", "cos", "log", "sqrt"),
        parsimony_coefficient=0.002,
        feature_names=data.names,
        metric="mse",
        random_state=0,
    )
    model.fit(*data.few(SLOW_ROWS))
    return [n for n in data.names if n in str(model._program)], model.predict(data.test)


WAYS = {
    "lightgbm": trees,
    "pygam": additive,
    "pysindy": sparse,
    "gplearn": symbolic,
}


def results(folder: Path, only: list[str]) -> Iterator[dict[str, Any]]:
    """What each installed way finds of each table."""
    installed = [name for name in only if importlib.util.find_spec(name)]
    for name in sorted(set(only) - set(installed)):
        print(f"SKIPPED: {name} is not installed")
    for file in sorted(folder.glob("*.parquet")):
        about = json.loads(file.with_suffix(".json").read_text())
        given = data(pd.read_parquet(file))
        for name in installed:
            begin = time.process_time()
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    found, predicted = WAYS[name](given)
            except Exception as error:
                yield about | {"way": name, "error": f"{type(error).__name__}: {error}"}
                continue
            yield about | {
                "way": name,
                "found": sorted(same(found)),
                "right": same(found) == frozenset(about["wanted"]),
                "before_mm": rms(given.test_mm),
                "after_mm": rms(given.test_mm - predicted),
                "seconds": time.process_time() - begin,
            }


def main() -> None:
    """Run what is asked for, and print a line per way."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("tables", type=Path, help="a folder that the judge kept")
    parser.add_argument("--only", default=",".join(WAYS), help="ways, with commas")
    parser.add_argument("-o", dest="out", type=Path, help="a line of JSON per result")
    asked = parser.parse_args()
    found = []
    for result in results(asked.tables, asked.only.split(",")):
        found.append(result)
        print(json.dumps(result), flush=True)
        if asked.out:
            with asked.out.open("a", encoding="utf-8") as file:
                file.write(json.dumps(result) + "\n")
    print("\n".join(table(found)))


def table(found: list[dict[str, Any]]) -> Iterator[str]:
    """A line per way: of hidden cases, then how often it says something where nothing is hidden."""
    yield f"{'':10} cases  right covariates  within 10 % of the floor  seconds   nulls  says any"
    for way in dict.fromkeys(r["way"] for r in found):
        mine = [r for r in found if r["way"] == way]
        good = [r for r in mine if "error" not in r]
        hidden = [r for r in good if r["wanted"]]
        nulls = [r for r in good if not r["wanted"]]
        near = [r["after_mm"] < 1.1 * r["floor_mm"] for r in hidden]
        seconds = np.median([r["seconds"] for r in good]) if good else np.nan
        shares = [np.mean(x) if x else np.nan for x in ([r["right"] for r in hidden], near)]
        says = np.mean([bool(r["found"]) for r in nulls]) if nulls else np.nan
        yield (
            f"{way:10} {len(hidden):5}  {shares[0]:16.2f}  {shares[1]:24.2f}  {seconds:7.1f}"
            f"   {len(nulls):5}  {says:8.2f}"
            + (f"  failed {len(mine) - len(good)}" * (mine != good))
        )


if __name__ == "__main__":
    main()
