import copy
import importlib.util
import json
from pathlib import Path

import jsonschema
import pytest
import yaml

from ntop.config.run import load_files
from ntop.config.tables import Actor, Sequence, read_tsv
from ntop.config.whole import body_model_of, check_tables, read_config, stage_section
from ntop.conventions import ConfigError

ROOT = Path(__file__).parents[1]
STUDIO = "config/studio.yaml"
SHIPPED = yaml.safe_load((ROOT / "config/config.yaml").read_text())


def actor(split="train", name="a"):
    return Actor(source="studio", actor=name, split=split)


def sequence(use, action="walk", **more):
    values = {"source": "studio", "actor": "a", "action": action, "first": 0, "last": 9} | more
    return Sequence(use=use, **values)


@pytest.mark.parametrize("name", ["config", "test", "studio"])
def test_the_shipped_configurations_and_tables_are_valid(name):
    merged = copy.deepcopy(SHIPPED)
    for key, value in yaml.safe_load((ROOT / f"config/{name}.yaml").read_text()).items():
        if isinstance(value, dict) and key in merged:
            merged[key].update(value)
        else:
            merged[key] = value
    config = read_config(merged)
    actors = read_tsv(ROOT / config.actors, Actor)
    sequences = read_tsv(ROOT / config.sequences, Sequence)
    check_tables(config, actors, sequences)
    assert actors
    assert sequences


def test_an_unknown_key_is_named_with_its_place():
    broken = copy.deepcopy(SHIPPED)
    broken["render"]["ring_radius"] = 1
    with pytest.raises(ConfigError, match=r"render\.ring_radius: unknown key; check the spelling"):
        read_config(broken)


def test_a_retired_key_says_what_to_write_instead():
    broken = copy.deepcopy(SHIPPED)
    broken["render"]["heights_above_pelvis_m"] = [1.2]
    with pytest.raises(ConfigError, match=r"use render\.rigs"):
        read_config(broken)


def test_an_unknown_reader_and_a_wrong_value_are_both_reported():
    broken = copy.deepcopy(SHIPPED)
    broken["sources"]["studio"]["reader"] = "holodeck"
    broken["train"] = {"steps": 0}
    with pytest.raises(ConfigError) as caught:
        read_config(broken)
    assert "holodeck" in str(caught.value)
    assert "train.steps" in str(caught.value)


def test_an_override_with_an_unknown_key_is_an_error():
    broken = copy.deepcopy(SHIPPED)
    broken["sources"]["studio"]["overrides"] = {"train": {"stepz": 3}}
    config = read_config(broken)
    with pytest.raises(ConfigError, match="stepz"):
        stage_section(config, "train", source="studio")


def test_a_source_hands_its_facts_to_its_stages_only():
    config = read_config(SHIPPED)
    assert stage_section(config, "train", source="balancing")["held_out_views"] == ["cam04"]
    assert "held_out_views" not in stage_section(config, "train", source="studio")


def test_a_gender_without_a_model_file_is_an_error():
    changed = copy.deepcopy(SHIPPED)
    changed["sources"]["balancing"]["body_models"] = {"f": "models/SMPL_FEMALE.pkl"}
    config = read_config(changed)
    woman, man = (Actor(source="balancing", actor=g, split="train", gender=g) for g in "fm")
    assert body_model_of(config, woman) == "models/SMPL_FEMALE.pkl"
    with pytest.raises(ConfigError, match=r"no file for gender 'm'.*have \['f'\]"):
        body_model_of(config, man)
    assert body_model_of(config, Actor(source="studio", actor="a", split="val")) == ""


def test_an_actor_in_two_splits_is_an_error():
    config = read_config(SHIPPED)
    rows = [sequence("train"), sequence("render", action="sit")]
    with pytest.raises(ConfigError, match=r"studio/a is listed twice \(split train and val\)"):
        check_tables(config, [actor("train"), actor("val")], rows)


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ([sequence("train")], "expected at least one"),
        ([sequence("train"), sequence("render", last=0, first=3)], "lies before first"),
        ([sequence("train"), sequence("render"), sequence("render")], "two lines"),
        ([sequence("train"), sequence("render", actor="b")], "not in"),
        ([sequence("train"), sequence("render", motion="authored:sit")], "another action name"),
    ],
)
def test_tables_that_contradict_themselves_are_refused(rows, words):
    with pytest.raises(ConfigError, match=words):
        check_tables(read_config(SHIPPED), [actor()], rows)


def test_a_broken_table_names_file_line_and_column(tmp_path):
    path = tmp_path / "actors.tsv"
    path.write_text("source\tactor\tsplit\nstudio\ta\ttest\n")
    with pytest.raises(ConfigError, match=r"actors\.tsv line 2.*\n.*split"):
        read_tsv(path, Actor)
    with pytest.raises(ConfigError, match="cannot read table"):
        read_tsv(tmp_path / "missing.tsv", Actor)


def test_the_page_and_the_schema_of_all_keys_are_in_step_with_the_models():
    path = ROOT / "scripts/write_config_reference.py"
    spec = importlib.util.spec_from_file_location("write_config_reference", path)
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    assert (ROOT / "config/README.md").read_text() == script.reference(), (
        "run: python scripts/write_config_reference.py"
    )
    assert script.SCHEMA.read_text() == script.schema(), "run the same script"


@pytest.mark.parametrize("name", ["config", "test", "studio"])
def test_editors_find_the_schema_and_the_shipped_files_follow_it(name):
    path = ROOT / f"config/{name}.yaml"
    first = path.read_text().splitlines()[0]
    place = first.removeprefix("# yaml-language-server: $schema=")
    schema = json.loads((path.parent / place).read_text())
    jsonschema.validate(yaml.safe_load(path.read_text()), schema)
    with pytest.raises(jsonschema.ValidationError, match="stepz"):
        jsonschema.validate({"train": {"stepz": 1}}, schema)


def test_the_demo_and_the_studio_never_replace_each_others_results():
    """Results are kept by source and actor: one name must not stand for two recipes."""
    runs = [load_files([ROOT / name], directory=ROOT) for name in ("config/config.yaml", STUDIO)]
    demo, studio = ({(row.source, row.actor) for row in run.actors} for run in runs)
    assert demo and studio and not demo & studio
