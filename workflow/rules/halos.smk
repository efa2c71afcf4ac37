rule halos:
    output:
        ensure(chunk("halos"), non_empty=True),
    params:
        settings=settings("halos"),
    log:
        results("logs/halos/{start}-{stop}.log"),
    benchmark:
        results("benchmarks/halos/{start}-{stop}.tsv")
    resources:
        mem_mb=1000,
        runtime=60,
        sample_seconds=SAMPLE_SECONDS,
    message:
        "halos: samples {wildcards.start} to {wildcards.stop}"
    shell:
        "warmlens halos --params {params.settings:q} --span {wildcards.start} {wildcards.stop}"
        " --output {output:q} --sample-seconds {resources.sample_seconds} > {log:q} 2>&1"
