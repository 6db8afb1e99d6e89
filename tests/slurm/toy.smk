# Small jobs for what the stages do not show: which GPU a job sees, and jobs that do not end. The GPU
# is asked for as the stages ask, through `ntop lease`, which leaves SLURM's choice alone.
rule gpu:
    output:
        "gpu/{n}.txt",
    resources:
        gpu=1,
    params:
        other=lambda wildcards: {"a": "b", "b": "a"}[wildcards.n],
    # each waits for the other to have begun, so that both hold their GPU at the same time
    shell:
        "ntop lease -n {resources.gpu} -- sh -c 'echo ${{CUDA_VISIBLE_DEVICES-none}}'"
        " > gpu/{wildcards.n}.begun;"
        " until test -e gpu/{params.other}.begun; do sleep 0.1; done;"
        " cp gpu/{wildcards.n}.begun {output}"


rule cpu:
    output:
        "cpu.txt",
    resources:
        gpu=0,
    shell:
        "echo ${{CUDA_VISIBLE_DEVICES-none}} > {output}"


rule endless:
    output:
        "endless/{n}.txt",
    shell:
        "touch endless/{wildcards.n}.begun; exec sleep 3600"
