rule observed_summary:
    input:
        observed_scan=single("observed_scan"),
    output:
        ensure(single("observed_summary"), non_empty=True),
    params:
        settings=settings("observed_summary"),
    log:
        results("logs/observed_summary.log"),
    benchmark:
        results("benchmarks/observed_summary.tsv")
    resources:
        mem_mb=1000,
        runtime=10,
    message:
        "summary of the observation"
    shell:
        "warmlens observed-summary --params {params.settings:q}"
        " --observed-scan {input.observed_scan:q} --output {output:q} > {log:q} 2>&1"


rule summaries:
    input:
        scans=chunk("scans"),
    output:
        ensure(chunk("summaries"), non_empty=True),
    params:
        settings=settings("summaries"),
    log:
        results("logs/summaries/{start}-{stop}.log"),
    benchmark:
        results("benchmarks/summaries/{start}-{stop}.tsv")
    resources:
        mem_mb=1000,
        runtime=30,
    message:
        "summaries: samples {wildcards.start} to {wildcards.stop}"
    shell:
        "warmlens summaries --params {params.settings:q} --scans {input.scans:q}"
        " --output {output:q} > {log:q} 2>&1"
