rule smooth_model:
    input:
        observation=single("observation"),
    output:
        ensure(single("smooth_model"), non_empty=True),
    params:
        settings=settings("smooth_model"),
    log:
        results("logs/smooth_model.log"),
    benchmark:
        results("benchmarks/smooth_model.tsv")
    resources:
        mem_mb=3000,
        runtime=30,
    message:
        "smooth model: fit source, light and quasars"
    shell:
        "warmlens smooth-model --params {params.settings:q} --observation {input.observation:q}"
        " --output {output:q} > {log:q} 2>&1"
