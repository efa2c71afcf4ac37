rule scan_design:
    input:
        observation=single("observation"),
        smooth_model=single("smooth_model"),
    output:
        ensure(single("scan_design"), non_empty=True),
    params:
        settings=settings("scan_design"),
    log:
        results("logs/scan_design.log"),
    benchmark:
        results("benchmarks/scan_design.tsv")
    resources:
        mem_mb=3000,
        runtime=30,
    priority: 2
    message:
        "scan operator: what all positions share"
    shell:
        "warmlens scan-design --params {params.settings:q} --observation {input.observation:q}"
        " --smooth-model {input.smooth_model:q} --output {output:q} > {log:q} 2>&1"


rule scan_operator:
    input:
        observation=single("observation"),
        smooth_model=single("smooth_model"),
        design=single("scan_design"),
    output:
        ensure(results("scan_operator/shard-{start}-{stop}.h5"), non_empty=True),
    params:
        settings=settings("scan_operator"),
    log:
        results("logs/scan_operator/{start}-{stop}.log"),
    benchmark:
        results("benchmarks/scan_operator/{start}-{stop}.tsv")
    resources:
        mem_mb=3000,
        runtime=60,
    priority: 1
    message:
        "scan operator: positions {wildcards.start} to {wildcards.stop}"
    shell:
        "warmlens scan-operator --params {params.settings:q} --span {wildcards.start} {wildcards.stop}"
        " --observation {input.observation:q} --smooth-model {input.smooth_model:q}"
        " --design {input.design:q} --output {output:q} > {log:q} 2>&1"
