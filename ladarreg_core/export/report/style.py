"""The look of a report, on a screen and on A4 paper."""

STYLE = """
:root { color-scheme: light; --ink: #1b222c; --dim: #5a6675; --line: #d5dae1; --panel: #f5f7f9; }
* { box-sizing: border-box; }
body { margin: 0; background: #fff; color: var(--ink); font: 15px/1.45 system-ui, "Segoe UI", Roboto, sans-serif;
  -webkit-print-color-adjust: exact; print-color-adjust: exact; }
main { max-width: 1080px; margin: 0 auto; padding: 28px 24px 48px; }
h1 { font-size: 26px; line-height: 1.2; margin: 0 0 10px; overflow-wrap: anywhere; }
h2 { font-size: 19px; margin: 30px 0 10px; padding-top: 14px; border-top: 1px solid var(--line); }
h3 { font-size: 15px; margin: 18px 0 6px; }
p { margin: 0 0 8px; } ul { margin: 0 0 10px; padding-left: 20px; }
.dim, figcaption { color: var(--dim); } .lead { font-size: 17px; font-weight: 600; }
.badge { display: inline-block; padding: 1px 10px; border: 1px solid; border-radius: 7px; font-weight: 600;
  white-space: nowrap; }
.ok { color: #12633c; background: #e5f5ec; } .warn { color: #7a4b00; background: #fdf1da; }
.bad { color: #98221b; background: #fce8e6; }
.note { padding: 8px 12px; border-radius: 7px; border: 1px solid; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: 3px 18px; margin: 8px 0; }
dt { color: var(--dim); } dd { margin: 0; overflow-wrap: anywhere; }
figure { margin: 0; min-width: 0; } figcaption { font-size: 13px; margin-top: 4px; }
img { display: block; max-width: 100%; height: auto; border-radius: 4px; } .map { image-rendering: pixelated; }
.wide img { width: 100%; }
.pictures, .tables { display: grid; grid-template-columns: 1fr 1fr; gap: 16px; margin: 10px 0; align-items: start; }
.pictures.three { grid-template-columns: repeat(3, 1fr); } .tables { gap: 30px; grid-template-columns: 2fr 3fr; }
.pictures img { width: 100%; }
.plots { display: grid; grid-template-columns: repeat(3, 1fr); gap: 14px; margin: 14px 0 4px; align-items: start; }
.plots svg { width: 100%; height: auto; display: block; }
.worst { display: grid; grid-template-columns: 1fr 1fr; gap: 16px; }
.pair { display: grid; grid-template-columns: 1fr 1fr; gap: 6px; }
.pair svg { width: 100%; height: auto; display: block; }
.legend { font-size: 13px; margin-top: 6px; } .legend p { margin: 0 0 4px; }
.ramp { display: block; width: 100%; height: 12px; } .ends { display: flex; justify-content: space-between; }
.keys { font-size: 13px; } .key { display: inline-block; margin-right: 16px; } .key svg { vertical-align: -2px; }
table { border-collapse: collapse; margin: 6px 0 10px; }
td, th { padding: 3px 14px 3px 0; text-align: left; vertical-align: top; }
th { color: var(--dim); font-weight: 500; border-bottom: 1px solid var(--line); } td { overflow-wrap: anywhere; }
.number { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
.code, code { font: 12px/1.45 ui-monospace, Consolas, monospace; } .findings td { padding-bottom: 7px; }
.steps { columns: 2; column-gap: 30px; max-width: 760px; }
.options { columns: 3; column-gap: 20px; font-size: 11px; }
.options code { font-size: 11px; color: var(--dim); }
.options div { break-inside: avoid; overflow-wrap: anywhere; }
@media screen and (max-width: 700px) {
  .pictures, .pictures.three, .tables, .worst, .plots { grid-template-columns: 1fr; }
  .options { columns: 1; } }
@page { size: A4; margin: 14mm 13mm;
  @bottom-right { content: counter(page) " / " counter(pages); font: 9px sans-serif; } }
@media print {
  body { font-size: 10.5px; } main { max-width: none; padding: 0; } h1 { font-size: 19px; }
  h2 { font-size: 14px; margin-top: 16px; padding-top: 8px; }
  h3 { font-size: 11.5px; } .lead { font-size: 12.5px; } figcaption, .legend, .keys { font-size: 9px; }
  .code, code { font-size: 8.5px; } .options, .options code { font-size: 7.5px; }
  h1, h2, h3 { break-after: avoid; } figure, table, tr, dl, .legend, .note { break-inside: avoid; }
  .findings, .steps table { break-inside: auto; } .keys { break-after: avoid; }
  .pictures, .worst, .tables { gap: 9px; }
  .wide img { max-height: 118mm; width: auto; margin: 0 auto; }
}
"""
"""The style sheet; nothing in it refers to another file."""

SUMMARY_STYLE = """
.photos td { padding: 10px 14px 10px 0; border-bottom: 1px solid var(--line); }
.photos img { width: 140px; } .photos ul { font-size: 13px; } .photos td:first-child { width: 154px; }
.photos p { margin: 2px 0; } .photos td:last-child { white-space: nowrap; padding-right: 0; }
"""
"""What the summary page of many photographs has besides."""

BATCH_STYLE = """
.tools { display: flex; flex-wrap: wrap; gap: 8px; margin: 14px 0; align-items: center; }
.tools button, .tools select, .tools input { font: inherit; padding: 4px 11px; border: 1px solid var(--line);
  border-radius: 7px; background: #fff; color: inherit; }
.tools button[aria-pressed=true] { background: var(--ink); color: #fff; border-color: var(--ink); }
.tools input { flex: 1 1 12rem; min-width: 0; } .photos { width: 100%; }
.figures { display: grid; grid-template-columns: repeat(auto-fit, minmax(9rem, 1fr)); gap: 10px; }
.figures div { background: var(--panel); border-radius: 7px; padding: 8px 12px; }
.figures b { display: block; font-size: 21px; font-variant-numeric: tabular-nums; } tr[hidden] { display: none; }
@media screen and (max-width: 700px) { .photos td:first-child, .photos img { width: 84px; }
  .photos td:last-child { display: none; } }
@media print { .tools { display: none; } }
"""
"""What the page of a batch has besides that."""
