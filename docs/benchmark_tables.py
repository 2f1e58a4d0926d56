"""The tables of the pages that show what `benchmarks/` measured, from the JSON files next to the pages."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Mapping
from pathlib import Path
from statistics import median
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from IPython.display import Markdown
from kind_tables import markdown_table
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from taciturn import style

Row = Mapping[str, Any]


def measured(name: str) -> Any:
    """Return the contents of a JSON file next to this module."""
    return json.loads(Path(__file__).with_name(f"{name}.json").read_text(encoding="utf-8"))


def machine(*names: str) -> None:
    """Print the machines on which files were measured."""
    for name in names:
        print(f"{name}.json: {', '.join(f'{key} {value}' for key, value in measured(name)['machine'].items())}")


def same_rate() -> None:
    """Print all policies on three plants at three rates, and check what the page says of them."""
    for table in measured("comparison"):
        base = table["cost_all_time"]
        print(f"{table['title']}, {table['share']:.0%} of the base rate; every sample {base:.6g}")
        print(f"  {'':20}{'link':10}{'parameter':30}{'above, %':>10}{'':12}{'guaranteed, %':>14}")
        for place in table["ranking"]:
            p, above = place["parameter"], place["above_best"]
            known = [value for value in (p["value"], p["beyond"]) if value is not None]
            values = " and ".join(str(value) if isinstance(value, list) else f"{value:.4g}" for value in known)
            spread = f" ({100 * above['standard_error'] / base:.1g})" if above["standard_error"] else ""
            print(
                f"  {place['name']:20}{place['link']:10}{p['name'] + ' = ' + values:30}"
                f"{_percent(place['cost']['value'], base):>10}{spread:12}{_percent(place['cost_bound'], base):>14}"
            )
        for name, why in table["left_out"].items():
            print(f"  {name:20}{why.split('; expected')[0].split(' (beyond')[0]}")
        print()
        cost = {place["name"]: place["cost"]["value"] for place in table["ranking"]}
        assert table["ranking"][0]["name"] in {"absolute, model", "consistent"}
        assert cost["rollout"] < cost["periodic"] or (table["plant"], table["share"]) == ("two-mass", 0.1)
        assert min(cost.values()) < cost.get("periodic, model", cost["periodic"])


def random_plants() -> None:
    """Print how often one policy costs less than another on random plants, and check what the page says of it."""
    counts: dict[tuple[str, str, str], tuple[int, int, int]] = {}
    for actuation in ("hold", "model"):
        for one, other in (("excess", "lqg"), ("excess", "clock"), ("lqg", "clock"), ("relative", "clock")):
            pairs = [
                (row["costs"][one], row["costs"][other])
                for row in measured("random_plants")
                if row["actuation"] == actuation and {one, other} <= row["costs"].keys()
            ]
            apart = [(a - b) / (4 * (e**2 + f**2) ** 0.5 + 1e-6) for (a, e), (b, f) in pairs]  # exact to 1e-6
            less, more = sum(x < -1 for x in apart), sum(x > 1 for x in apart)
            counts[actuation, one, other] = less, more, len(pairs)
            shown = "periodic" if other == "clock" else other
            print(f"{actuation:6}{one:9} costs less than {shown:9} in {less:2} of {len(pairs)} cases, more in {more:2}")
    assert counts["model", "excess", "lqg"][1] == 0
    assert counts["hold", "excess", "lqg"] == (25, 2, 30)
    assert all(counts[actuation, "excess", "clock"][1] == 0 for actuation in ("hold", "model"))


def limited() -> None:
    """Print what forecasts with the limits of inputs change at equal rates, and check what the page says of them."""
    ahead = (1, 3, 10, 30)
    print(f"{'loop':22}{'at a limit':>11}{'rate':>7}{'':3}{''.join(f'{k:>7}' for k in ahead)}{'±':>7}")
    for cell in measured("limited"):
        name, share = cell["loop"], f"{cell['at a limit']:.0%}"
        for i, rate in enumerate(cell["rates"]):
            change = [100 * (cell[f"forecast of {k}"][i] / cell["without"][i] - 1) for k in ahead]
            shown = "".join(f"{one:>+7.1f}" for one in change)
            print(f"{name:22}{share:>11}{rate:>7.2f}{'':3}{shown}{100 * cell['errors'][i]:>7.1f}")
            assert change[2] < 1
            name = share = ""


def engine() -> None:
    """Print the speed of simulations of the two masses."""
    found = measured("benchmarks")
    print(f"{'':46}{'million steps/s':>16}{'rate':>7}{'compile s':>11}{'import s':>10}{'peak MB':>9}")
    for name, row in found["contestants"].items():
        times = f"{row['compile']:11.2f}{row['import']:10.2f}{row['peak_megabytes']:9.0f}"
        print(f"{name:46}{row['steps_per_second'] / 1e6:16.4g}{row['rate']:7.3f}{times}")
    print("\nratios:", ", ".join(f"{name} {value:.3g}".replace("_", " ") for name, value in found["ratios"].items()))
    for name, seconds in found["compile_seconds"].items():
        print(f"machine code of the innovations form, {name}: {1000 * seconds:.1f} ms")
    for name, speed in found["normals"].items():
        print(f"normals, {name}: {speed / 1e6:.0f} million per second")


def engine_figure() -> Figure:
    """Return the figure of these speeds."""
    shown = sorted(measured("benchmarks")["contestants"].items(), key=lambda entry: entry[1]["steps_per_second"])
    colors = ["C0" if name.startswith(("full", "innovations")) else "0.6" for name, _ in shown]
    figure, axes = plt.subplots(figsize=(7, 4))
    axes.barh([name for name, _ in shown], [row["steps_per_second"] for _, row in shown], color=colors)
    axes.set(xscale="log", xlabel="steps per second, one thread")
    figure.tight_layout()
    return figure


def estimators() -> None:
    """Print what the estimators save, and how long answers take."""
    found = measured("benchmarks")
    for name, ratio in found["variance_ratios"].items():
        print(f"variance per step, {name.replace('_', ' ')}: {ratio:.3g} times less")
    answer = found["answers"]
    print(f"\nto a cost known to 1e-4 by a plain average ({answer['steps_of_the_plain_average']:.2g} steps):")
    programs = ("innovations", "C++ by hand, innovations", "JAX scan, innovations", "NumPy over paths")
    for name in (*programs, "NumPy, path by path"):
        if name in found["contestants"]:
            print(f"  {name}: {answer['seconds_by_plain_average'][name]:.3g} s")
    imports = f"after imports of {answer['of_which_imports']:.2f} s"
    print(f"taciturn.evaluate: {answer['of_which_evaluation']:.3f} s {imports}")
    print(f"from process start to the answer: {answer['process_start_to_answer']:.2f} s")


def answers() -> None:
    """Print for each built-in problem the time until the cost has a standard error of 1e-4 of it."""
    for row in measured("benchmarks")["policies"]:
        reached = "" if row["reached"] else ", NOT REACHED"
        effort = f"{row['steps']:.2g} steps" if row["steps"] else row["method"]
        print(
            f"{row['problem']} ({row['policy']}): {row['seconds']:.3g} s, {effort}, mostly {row['limited_by']}{reached}"
        )


def choices() -> None:
    """Print how the chosen method compares with the fastest of all methods."""
    auto = measured("auto")
    print(f"{'':32}{'cases':>6}{'within 2 x':>12}{'worst':>7}")
    groups = {"all": auto["summary"]}
    groups |= {f"to {asked} of the cost": row for asked, row in auto["by_error"].items()}
    groups |= {f"chosen: {method}": row for method, row in auto["by_method"].items()}
    for name, row in groups.items():
        print(f"{name:32}{row['cases']:6}{row['within_2']:12.1%}{row['worst']:7.2f}")


def large_loops() -> None:
    """Print compile times and speeds of loops with random dense matrices."""
    print(
        f"{'n_z':>4} {'form':12}{'operations':>11}{'in loops':>9}{'compile s':>11}{'million steps/s':>17}{'of peak':>9}"
    )
    for row in measured("benchmarks")["growth"]:
        share = "" if row["share_of_peak"] is None else f"{row['share_of_peak']:.0%}"
        numbers = f"{row['operations']:11}{row['products']:9}{row['compile']:11.2f}{row['steps'] / 1e6:17.4g}{share:>9}"
        print(f"{row['n_z']:4} {row['form']:12}{numbers}")


def other_loops() -> None:
    """Print the speed of the loops of the thesis, compared with NumPy."""
    for row in measured("benchmarks")["chapters"]:
        speed, ratio = row["engine"] / 1e6, row["engine"] / row["NumPy"]
        print(f"{row['loop']}: {speed:.3g} million steps/s, {ratio:.0f} times NumPy ({row['operations']} operations)")


def many_loops() -> None:
    """Print the time of one step of many loops side by side."""
    many = measured("benchmarks")["many_loops"]
    print(f"a step of 10,000 loops: {1000 * many['tick_of_ten_thousand']:.2f} ms", end="; ")
    print(f"to design and close one: {1000 * many['design_and_close']:.1f} ms")


def memory() -> None:
    """Print the largest memory of simulations; it does not grow with the number of steps."""
    found = measured("benchmarks")["memory"]
    print(", ".join(f"{steps} steps: {megabytes:.0f} MB at most" for steps, megabytes in found.items()))
    assert found["1e9"] < 1.1 * found["1e7"]


def starts() -> None:
    """Print the time that commands take to start, compared with the import of NumPy and scipy."""
    started = measured("start")
    print(f"{started['machine']['processor']}, vectors: {started['machine']['vectors']}")
    print(f"{'':52}{'processor s':>12}{'of the import':>15}{'wall s':>8}{'of the import':>15}")
    for name, row in started["commands"].items():
        processor = f"{row['processor']:12.2f}{row['processor_ratio']:15.2f}"
        print(f"{name:52}{processor}{row['wall']:8.2f}{row['wall_ratio']:15.2f}")


def scaling() -> None:
    """Print times of designs, evaluations and lower bounds by the number of states, without and with proofs."""
    found = measured("scaling")
    print(", ".join(f"{name} {value}" for name, value in found["machine"].items()))
    designs = [row for row in found["rows"] if row["task"] == "design"]
    print(f"\n{'design':8}{'states':>7}{'before ms':>18}{'now ms':>18}{'control ms':>12}{'now / control':>15}{'MB':>6}")
    for row in sorted(designs, key=lambda row: row["family"]):
        now, before = row["after"], row["before"]
        rest = f"{1000 * now['control']:12.3g}{now['ratio']:15.2f}{now['megabytes']:6.0f}" if now["control"] else ""
        print(f"{row['family']:8}{row['states']:7}{_milliseconds(before):>18}{_milliseconds(now):>18}{rest}")
    print(f"\n{'dense plant':14}{'states':>7}{'before ms':>18}{'now ms':>18}{'MB before':>11}{'MB now':>8}")
    for row in found["rows"]:
        if row["task"] != "design":
            now, before = row["after"], row["before"]
            held = "".join(
                f"{'' if one['megabytes'] is None else round(one['megabytes']):>{width}}"
                for one, width in ((before, 11), (now, 8))
            )
            print(f"{row['task']:14}{row['states']:7}{_milliseconds(before):>18}{_milliseconds(now):>18}{held}")
    print()
    for name in ("before", "after"):
        for row in found["rows"]:
            if row[name]["refused"] and row[name]["seconds"] is not None:
                print(f"{name}, {row['task']} {row['family']} {row['states']}: {row[name]['refused']}")


def load() -> None:
    """Print how late one controller process is that serves many loops."""
    print(
        f"{'loops':>6} {'steps':>8} {'lost':>5} {'late p50':>9} {'p95':>6} {'p99':>6} {'max ms':>7} {'processor':>10}"
    )
    for run in measured("load")["runs"]:
        late = run["lateness_ms"]
        print(
            f"{run['loops']:6} {run['ticks']:8} {run['lost_ticks']:5} {late['p50']:9.1f} {late['p95']:6.1f} "
            f"{late['p99']:6.1f} {late['max']:7.1f} {run['cpu_share']:10.0%}"
        )
        assert run["packets_back"] == run["packets_sent"]


def recovery() -> None:
    """Print how long nodes over UDP take to recover from each fault, or how many steps of a minute are not good."""
    found = measured("recovery")
    print(f"{'fault':72}{'median':>8}{'largest':>9}")
    for row in found["rows"]:
        unit, digits = ("steps", 0) if row["counts"] else ("s", 2)
        numbers = (median(row["after"]), max(row["after"]))
        print(f"{row['fault']:72}" + "".join(f"{one:{8 + k}.{digits}f}" for k, one in enumerate(numbers)) + f" {unit}")


def boards() -> None:
    """Print code size, memory and instructions of nodes on emulated boards."""
    kept = measured("devices")
    print(", ".join(kept["tools"].values()))
    head = f"{'':24}{'code':>6}{'const':>6}{'RAM':>5}{'oper.':>6}{'step':>7}{'tick':>7}{'all':>7}{'longest':>8}"
    for policy, devices in kept["policies"].items():
        print(f"\n{policy}\n{head}")
        for device, found in devices.items():
            for role, node in found["nodes"].items():
                counts = node["instructions"]
                print(
                    f"  {device:11} {role:10}{node['code']:6}{node['constants']:6}{node['memory']:5}"
                    f"{node['operations']:6}"
                    + "".join(f"{counts[what]['mean']:7.0f}" for what in ("step", "tick", "all"))
                    + f"{counts['all']['longest']:8}"
                )
    core = kept["policies"]["chapter 2, two-mass"]["M3 float64"]["core"]
    print(f"\nThe core, once on each device: {core['code']} bytes of code, {core['constants']} of constants.")


def by_hand() -> None:
    """Print the instructions of a generated step and of steps written by hand."""
    print(f"{'':20}{'generated':>10}{'loops':>8}{'by hand':>9}{'ratio':>8}{'symmetry':>10}")
    for device, ways in measured("devices")["by hand"].items():
        mean = {way: found["mean"] for way, found in ways.items()}
        best = min(mean["loops"], mean["hand"])
        numbers = f"{mean['generated']:10.0f}{mean['loops']:8.0f}{mean['hand']:9.0f}"
        print(f"{device:20}{numbers}{mean['generated'] / best:8.3f}{mean['symmetry']:10.0f}")
        # only the generated step knows missing samples and manual inputs, by flags that are numbers
        assert mean["generated"] <= 1.35 * best


def misra() -> None:
    """Print how often the core deviates from each rule of MISRA C:2012, and why."""
    found = measured("misra")
    print(f"{'rule':7}{'category':10}" + "".join(f"{version:>8}" for version in found["versions"]) + "  reason")
    for rule, row in found["rules"].items():
        numbers = "".join(f"{row['found'].get(version, 0):8}" for version in found["versions"])
        first, *rest = textwrap.wrap(row["reason"], 64)
        print(f"{rule:7}{row['category']:10}{numbers}  {first}", *(f"{'':35}{line}" for line in rest), sep="\n")


def pids_on_two_nodes(*, full: bool = False) -> Markdown:
    """Return rates and bounds of three published PID controllers with a link for sensor and actuator each.

    In short: the rules at equal cost. In full: all rules, with the rates of both links, costs and certificates.
    """
    found = measured("every_path")["published"]
    if not full:
        names = {
            "bank, hold": "bank, held values",
            "bank, model in the valve": "bank, the valve predicts",
            "send-on-delta": "send-on-delta",
        }
        rows = [
            (shown, *(f"{rows[name]['traffic'][0]:.3g} ({rows[name]['promise']:.2f})" for rows in found.values()))
            for name, shown in names.items()
        ]
        periodic = (f"{rows['periodic']['same cost']['traffic']:.3g} (none)" for rows in found.values())
        return Markdown(
            markdown_table(("packets per second (bound)", *found), [*rows, ("periodic control", *periodic)])
        )
    heading = ("rule", "sensor", "valve", "both", "cost", "guarantee", "certificate")
    parts: list[str] = []
    for case, kept in found.items():
        rows = [
            (
                name,
                *(f"{one[0]:.3f}" for one in (*row["rates"].values(), row["traffic"])),
                "{:.3f}\N{NO-BREAK SPACE}±\N{NO-BREAK SPACE}{:.4f}".format(*row["cost"]),
                f"{row['promise']:.3f}",
                "none" if row["certificate"] is None else f"{row['certificate'][0]:.3f}",
            )
            for name, row in kept.items()
            if name != "periodic"
        ]
        rows += [
            (f"periodic, {name}", "", "", f"{row['traffic']:.3f}", f"{row['cost']:.3f}", "none", "none")
            for name, row in kept["periodic"].items()
        ]
        parts.append(f"**{case}**\n\n{markdown_table(heading, rows)}")
    return Markdown("\n\n".join(parts))


def published_pids(*, full: bool = False) -> Markdown:
    """Return the packets of three published PID controllers under the rules that keep a controller, at equal cost.

    In short: the best variant of each rule. In full: all variants.
    """
    kept = measured("published_pids")
    first = [row["periodic"] for row in kept.values()]
    rows = [("every sample", *(f"{row['every sample']:.3g}" for row in first))]
    periods = ("at its own step", "discretised anew")
    rules = [rule for rule in kept["three lags"] if rule != "periodic"]
    if full:
        rows += [(f"periodic, {words}", *(f"{row[words]['rate']:.3f}" for row in first)) for words in periods]
        for rule in rules:
            shown = (
                f"{row[rule]['rate']:.3f} ± {row[rule]['rate_error']:.3f}" if "rate" in row[rule] else "none"
                for row in kept.values()
            )
            rows.append((rule, *shown))
    else:
        rows.append(("periodic", *(f"{min(row[words]['rate'] for words in periods):.3g}" for row in first)))
        for name in dict.fromkeys(rule.partition(",")[0] for rule in rules):
            variants = [rule for rule in rules if rule.partition(",")[0] == name]
            least = (min(row[rule]["rate"] for rule in variants if "rate" in row[rule]) for row in kept.values())
            rows.append((f"`{name}`", *(f"{rate:.3g}" for rate in least)))
    rows.append(("cost of LQG, every sample", *(f"{row['LQG']:.3f}" for row in first)))
    return Markdown(markdown_table(("packets per second", *kept), rows))


def channel_bounds() -> None:
    """Print how close the price scheduler is to the bound for every scheduler, and check what the page says of it."""
    tables = measured("channel")
    last = "price over the bound: of the cost, of the bound, %"
    print(f"{'loops':>7}{'slots':>7}{'bound, %':>10}{'price, %':>10}{'periodic, %':>13}{last:>52}")
    for loops in (2, 10, 100, 1000, 10_000, 100_000):
        one = tables[f"gap {loops}"]
        low, cost, periodic = _above(one)
        base, bound = one["cost_all_time"], one["cost_lower_bound"]
        gap, spread = 100 * (one["cost"]["value"] - bound), 100 * one["cost"]["standard_error"]
        extra = f"{gap / (bound - base):9.1f}" if loops > 2 else ""
        shares = f"{gap / bound:20.3f} ± {spread / bound:.3f}{extra}"
        print(f"{loops:7}{one['capacity']:7}{low:10.2f}{cost:10.2f}{periodic:13.2f}{shares}")
        assert one["consistent"] or loops == 2
    many = tables["gap 10000"]
    assert many["cost"]["value"] + 4 * many["cost"]["standard_error"] < 1.02 * many["cost_lower_bound"]


def schedulers() -> None:
    """Print what each scheduler of a channel costs, and check what the page says of random access."""
    tables = measured("channel")
    print(f"{'':15}{'above every sample, %':>22}{'load':>8}{'on the channel':>16}{'waiting':>9}")
    for name in ("price", "largest", "once-discard", "tdma", "round-robin", "random-access"):
        one = tables[f"scheduler {name}"]
        spread = 100 * one["cost"]["standard_error"] / one["cost_all_time"]
        waiting = one["waiting"]["value"] if one["waiting"] else float("nan")
        cost = f"{_above(one)[1]:15.2f} ± {spread:.2f}"
        print(f"{name:15}{cost}{one['load']['value']:8.1f}{one['busy']['value']:16.1f}{waiting:9.1f}")
    assert tables["scheduler random-access"]["consistent"] is False


def loops_per_slot() -> None:
    """Print how many loops a slot carries at a largest cost of each."""
    last = "100 against periodic"
    print(f"{'loops per slot':26}{'cost':>6}{'periodic':>10}{'1 slot':>8}{'10':>8}{'100':>8}{'free':>8}{last:>22}")
    for row in (row for name, row in measured("channel").items() if name.startswith("carried")):
        slots = [row[f"slots {slots}"] for slots in (1, 10, 100)]
        cells = "".join(f"{value:8.2f}" for value in (*slots, row["free"]))
        print(f"{row['problem']:26}{row['budget']:6}{row['clock']:10.2f}{cells}{slots[-1] / row['clock']:21.2f}×")
        assert slots[-1] > row["clock"]


def channel_effort() -> None:
    """Print time and memory of channels with many loops, and of complete runs with equal and with different loops."""
    tables, effort = measured("channel"), measured("loops")
    for loops in (1000, 10_000, 100_000):
        one = tables[f"growth {loops}"]
        time, memory = one["nanoseconds"], one["bytes_per_loop"]
        print(f"{loops:7} loops: {time:5.1f} ns per loop and step, {memory:4.0f} bytes per loop")
    print(f"the price of 1,000 loops of 20 plants: {tables['twenty']['seconds']:.0f} s\n")
    print(f"{'loops':>7}  {'copies':>20}  {'different':>20}")
    for loops in sorted({row["loops"] for row in effort.values()}):
        rows = [effort.get(f"after {kind} {loops}") for kind in ("copies", "different")]
        cells = [
            "not run" if row is None
            else f"{row['seconds']:8.1f} s{row['megabytes']:7.0f} MB" if "seconds" in row
            else f"> {row['limit']} s"
            for row in rows
        ]  # fmt: skip
        print(f"{loops:7}  " + "  ".join(cell.rjust(20) for cell in cells))


def executors() -> None:
    """Print the overhead of each executor of a sweep."""
    found = measured("sweeps")
    print(f"{found['cells']} cells of {1e3 * found['cell']:.1f} ms, {found['machine']['processors']} processors")
    print(f"{'':12}{'workers':>8}{'seconds':>9}{'efficiency':>12}{'ms more per cell':>18}{'start s':>9}")
    alone = {row["executor"]: row["seconds"] for row in found["rows"] if row["workers"] == 1}
    for row in found["rows"]:
        efficiency = alone.get(row["executor"], alone["here"]) / row["workers"] / row["seconds"]
        numbers = f"{row['workers']:8}{row['seconds']:9.2f}{efficiency:12.3f}{1e3 * row['overhead']:18.3f}"
        print(f"{row['executor']:12}{numbers}{row['start']:9.2f}")
    print(f"a store: {1e3 * found['store']:.2f} ms more per cell, of the process that distributes")
    print("memory of a worker, MB:", {cells: round(size) for cells, size in found["memory"].items()}, "cells")


def nonlinear_figure() -> Figure:
    """Return where two nonlinear plants keep the bound of their linearisation, and check what the page says of it."""
    cells = measured("nonlinear")
    titles = {"pendulum-on-a-cart": "pendulum on a cart", "omni-heading": "robot that turns"}
    colors = {"kept": "#9ecae1", "broken": "#fc9272", "open": "white", "fails": "0.8"}
    figure, axes = plt.subplots(2, 1, figsize=(7, 6), layout="constrained")
    for axis, (name, title) in zip(axes, titles.items(), strict=True):
        own = [cell for cell in cells if cell["plant"] == name]
        scales, thetas = (sorted({cell[key] for cell in own}) for key in ("scale", "theta"))
        for cell in own:
            i, j = scales.index(cell["scale"]), thetas.index(cell["theta"])
            axis.add_patch(Rectangle((i - 0.5, j - 0.5), 1, 1, fc=colors[_verdict(cell)], ec="white"))
            if "cost" in cell:
                always = cell["cost"] - cell["above_always"]
                text = f"{cell['cost'] / cell['cost_all_time']:.3f}\n{cell['cost'] / always:.3f}"
                axis.text(i, j, text, ha="center", va="center", fontsize="small")
        axis.set(xlim=(-0.5, len(scales) - 0.5), ylim=(-0.5, len(thetas) - 0.5), ylabel="θ", title=title)
        axis.set_xticks(range(len(scales)), [f"{scale:g}" for scale in scales])
        axis.set_yticks(range(len(thetas)), [f"{theta:g}" for theta in thetas])
    axes[-1].set_xlabel("standard deviation of the noise, in that of the problem file")
    assert all(_verdict(cell) == "kept" for cell in cells if cell["scale"] <= 4.0)
    return figure


def identified_robots() -> None:
    """Print the models that were identified from pictures of the robots."""
    for robot, found in measured("twins")["models"].items():
        model, camera = found["model"], found["calibration"]
        B, error, sheet = (np.diag(np.array(model[name])) for name in ("B", "B_standard_error", "B_nominal"))
        free, of_free = (np.diag(model[name]).round(4) for name in ("A_free", "A_free_standard_error"))
        print(f"{robot}: landmarks {camera['error']:.2f} pixels off; {model['samples']} steps")
        print("  B     ", np.round(B, 5), "±", np.round(error, 5), " data sheet", sheet)
        print("  √W    ", np.round(1e3 * np.sqrt(np.diag(model["W"])), 1), "mm or mrad per step")
        print("  A free", free, "±", of_free)
        assert (sheet > B).all()  # slip and stiction: the robots are a little slower than their data sheet


def rover() -> None:
    """Print the results of the rover next to those of the thesis, and check what the page says of them."""
    run = measured("twins")["rover"]["summary"]
    asked, sent = (run["rates"][link] for link in ("sensor", "actuator"))
    above, cost = run["cost_over_all_time"], run["cost"]
    print(f"asked {asked['value']:.3f} (thesis: 0.20), sent {sent['value']:.3f} ± {sent['standard_error']:.3f} (0.10)")
    print(f"cost {cost['value']:.1f} ± {cost['standard_error']:.1f}; every sample {run['cost_all_time']:.1f}")
    print(f"ratio {above['value']:.3f} ± {above['standard_error']:.3f} (thesis: 127.85 / 116.47 = 1.098)")
    print(f"guarantee {run['cost_bound']:.1f}; in theory every sample costs {run['cost_all_time_model']:.1f}")
    print("camera", {name: round(value, 2) for name, value in run["vision"]["x"].items()})
    assert cost["value"] < run["cost_bound"]
    assert above["value"] < 1.15
    assert sent["value"] < 0.15


def rover_figure() -> Figure:
    """Return a path of the rover with its inputs and requests."""
    plt.rcParams.update(style())
    kept = measured("twins")["rover"]
    figure, (top, bottom) = plt.subplots(2, 1, figsize=(7, 5), sharex=True)
    for name, label in (("path", "event-triggered"), ("path_all_time", "every sample")):
        top.plot(np.array(kept[name]["poses"])[:, 0], label=label)
        bottom.step(range(60), np.array(kept[name]["inputs"])[:, 0], where="post", label=label)
    top.plot(np.array(kept["path"]["estimates"])[:, 0], ":", label="event-triggered, estimated")
    for step in kept["path"]["sent"]["sensor"]:
        top.axvline(step, color="0.85", zorder=0)
    top.set_ylabel("x (m)")
    bottom.set(ylabel="input (%)", xlabel="step")
    top.legend()
    return figure


def omni() -> None:
    """Print the results of the omni-directional robot for each price, and check what the page says of them."""
    prices = measured("twins")["prices"]
    print("price   R_t             J               J_all+Nλ  J_all+Nλ(1−R_t)  off the path")
    for price, found in prices.items():
        run, off = found["summary"], found["off_mm"]
        rate, cost = (
            f"{one['value']:.3f} ± {one['standard_error']:.3f}" for one in (run["rates"]["actuator"], run["cost"])
        )
        bounds = f"{run['cost_bound']:.3f}     {run['cost_bound_at_rate']:.3f}"
        print(f"{price:6s}  {rate}   {cost}   {bounds}            {off['value']:.0f} ± {off['standard_error']:.0f} mm")
    last = prices["0.01"]["summary"]
    assert last["rates"]["actuator"]["value"] <= 0.15
    assert last["cost"]["value"] < last["cost_bound"]


def omni_figure() -> Figure:
    """Return the path of the omni-directional robot along two circles."""
    path = measured("twins")["prices"]["0.01"]["path"]
    x, y, _ = np.array(path["poses"]).T
    turn = np.linspace(0, 4 * np.pi, 251)
    side = np.where(turn < 2 * np.pi, -1, 1)
    sent = path["sent"]["actuator"]
    plt.rcParams.update(style())
    figure, axis = plt.subplots(figsize=(7, 3.6))
    axis.plot(side * (1 - np.cos(turn)), -np.sin(turn), "--", color="C7", lw=1, label="reference")
    axis.plot(x, y, label="twin")
    axis.plot(x[sent], y[sent], ".", color="C3", label=f"sends: {len(sent)} of 250")
    axis.set(aspect="equal", xlabel="x (m)", ylabel="y (m)")
    axis.legend(loc="lower center", bbox_to_anchor=(0.5, 1), ncols=3)
    return figure


def robot_faults() -> None:
    """Print one run of each robot for each fault."""
    kept = measured("twins")
    for robot in ("rover", "omni"):
        print(f"{robot:22s} cost     sends  largest  last metres off   (after a third of the run)")
        for fault, found in kept[f"faults of the {robot}"].items():
            largest, last = found["largest_off_m"], found["last_off_m"]
            print(f"  {fault:20s} {found['cost']:7.2f}  {found['sends']:4d}   {largest:.2f}     {last:.2f}")


def _above(document: Row) -> list[float]:
    base = document["cost_all_time"]
    costs = document["cost_lower_bound"], document["cost"]["value"], document["cost_periodic"]
    return [100 * (cost / base - 1) for cost in costs]


def _verdict(cell: Row) -> str:
    """Return whether a cell keeps the bound of the linearisation, breaks it, cannot tell, or has no average cost."""
    if "fails" in cell:
        return "fails"
    margin, over = 4 * cell["standard_error"], cell["cost"] - cell["cost_bound"]
    return "kept" if over + margin <= 0 else "broken" if over - margin > 0 else "open"


def _percent(value: float | None, base: float) -> str:
    return "none" if value is None else f"{100 * (value / base - 1):.3g}"


def _milliseconds(row: Row) -> str:
    if row["seconds"] is None:
        return str(row["refused"])
    return f"{1000 * row['seconds']:.3g}" + (" refused" if row["refused"] else "")
