from snakemake.utils import min_version

min_version("9.10")


configfile: "config/config.yaml"


report: "workflow/report/workflow.rst"


include: "workflow/rules/common.smk"
include: "workflow/rules/0_fetch.smk"
include: "workflow/rules/1_capture.smk"
include: "workflow/rules/2_mask.smk"
include: "workflow/rules/3_fit.smk"
include: "workflow/rules/4_train.smk"
include: "workflow/rules/5_render.smk"
include: "workflow/rules/6_annotate.smk"
include: "workflow/rules/7_assemble.smk"
include: "workflow/rules/8_evaluate.smk"


localrules:
    all,
    actor,
    fetch,  # a cluster's compute nodes seldom reach the internet


rule all:
    default_target: True
    input:
        f"results/8_evaluate/{CONFIG.dataset}",
