rule observed_scan:
    input:
        unpack(inputs("observed_scan")),
    output:
        ensure(output("observed_scan"), non_empty=True),
    params:
        settings=settings("observed_scan"),
        inputs=input_words,
    log:
        note("logs", "observed_scan", "log"),
    benchmark:
        note("benchmarks", "observed_scan", "tsv")
    resources:
        mem_mb=3000,
        runtime=60,
    message:
        "scan of the observation"
    shell:
        command("observed_scan")


rule scans:
    input:
        unpack(inputs("scans")),
    output:
        ensure(output("scans"), non_empty=True),
    params:
        settings=settings("scans"),
        inputs=input_words,
    log:
        note("logs", "scans", "log"),
    benchmark:
        note("benchmarks", "scans", "tsv")
    resources:
        mem_mb=3000,
        runtime=120,
    message:
        "scans: samples {wildcards.start} to {wildcards.stop}"
    shell:
        command("scans")
