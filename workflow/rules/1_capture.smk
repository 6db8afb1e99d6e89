# source footage -> frames and cameras in our conventions
def capture_packages(wildcards):
    section = CONFIG.sources[wildcards.source]
    rows = sequences_of(wildcards, "train") + sequences_of(wildcards, "render")
    if section.reader == "qualisys":
        return package_folders([section.package])
    rows = [row for row in rows if row.use == "train" or row.truth]
    return package_folders(motion_packages(rows))


def capture_params(wildcards):
    section = CONFIG.sources[wildcards.source]
    rows = sequences_of(wildcards, "train")
    rows += [row for row in sequences_of(wildcards, "render") if row.truth]
    extra = {
        "source_section": section.model_dump(mode="json", exclude_defaults=True)
        | {"reader": section.reader},
        "sequences": [row.model_dump(mode="json", exclude_defaults=True) for row in rows],
    }
    if any(row.truth for row in rows):
        rigs = CONFIG.render.rigs
        extra["rigs"] = {name: rig.model_dump(mode="json") for name, rig in rigs.items()}
        extra["image"] = CONFIG.render.image.model_dump(mode="json")
    return params_json("capture", None, extra)


rule capture:
    input:
        packages=capture_packages,
    output:
        directory("results/1_capture/{source}/{actor}"),
    log:
        "logs/1_capture/{source}/{actor}.log",
    benchmark:
        "results/benchmarks/1_capture/{source}/{actor}.tsv"
    resources:
        mem_mb=2000,
    params:
        config=capture_params,
        packages=PACKAGES,
    shell:
        "ntop capture --config {params.config:q} --source {wildcards.source}"
        " --actor {wildcards.actor} --packages {params.packages:q} --out {output:q} 2> {log:q}"
