# The report takes a second, and is there whenever a campaign is finished.
rule report:
    input:
        list(ARTIFACTS),
        [results(name) for name in ANSWER_FILES[ANSWER]],
        [pictures(names) for names in DRAWN.values()],
    output:
        page=ensure(results(REPORT), non_empty=True),
        ledger=ensure(results(REPORT_LEDGER), non_empty=True),
    params:
        version=REPORT_VERSION,
        folder=CAMPAIGN.results,
    log:
        results("logs/report.log"),
    benchmark:
        results("benchmarks/report.tsv")
    resources:
        mem_mb=1000,
        runtime=10,
    message:
        "report: one page of everything"
    shell:
        "warmlens report {params.folder:q} --output {output.page:q} > {log:q} 2>&1"
