// What the final evaluation reports beside figures: confusions, calibration and the scores of every frame.
#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <numeric>

#include "report/html.h"
#include "report/report_parts.h"
#include "report/report_sections.h"
#include "report/report_svg.h"

namespace semfield {

namespace {

constexpr const char* kNoDetail =
    "Left out, because their folders hold no final_eval.json (made by an older version, or not ended):";
constexpr std::size_t kMostClasses = 64;  // rows of a table that can still be read
constexpr std::size_t kMostConfusions = 5;

bool without_detail(const ReportRun& run) { return !run.eval; }

std::string px_text(std::int64_t pixels) { return count_text(pixels) + " px"; }

double ratio(std::int64_t part, std::int64_t whole) {
  return whole > 0 ? static_cast<double>(part) / static_cast<double>(whole) : 0;
}

// Sums of a confusion matrix.
struct Totals {
  std::vector<std::int64_t> truth, predicted;  // [classes]
  std::int64_t all = 0, wrong = 0;
  explicit Totals(const FinalEval& eval) : truth(eval.classes.size()), predicted(eval.classes.size()) {
    for (std::size_t t = 0; t < truth.size(); ++t) {
      for (std::size_t p = 0; p < truth.size(); ++p) {
        truth[t] += eval.count(t, p);
        predicted[p] += eval.count(t, p);
        all += eval.count(t, p);
        if (t != p) wrong += eval.count(t, p);
      }
    }
  }
};

struct Confusion {
  std::size_t truth, predicted;
  std::int64_t pixels;
  double share;  // of the true class
};

// "chair read as table: 12 % of chair", with pixels beneath.
std::string words_list(const FinalEval& eval, const Totals& totals, std::string_view title,
                       std::vector<Confusion> found) {
  found.resize(std::min(found.size(), kMostConfusions));
  std::string out = fmt::format("<div><h4>{}</h4>\n<ul>\n", title);
  for (const Confusion& c : found) {
    const FinalEval::Class &truth = eval.classes[c.truth], &predicted = eval.classes[c.predicted];
    out += fmt::format("<li>{}{} read as {}{}: {} of {}<small class=\"d\">{}, {} of all wrong pixels</small></li>\n",
                       swatch(truth.color), html_escape(truth.name), swatch(predicted.color),
                       html_escape(predicted.name), percent_text(c.share), html_escape(truth.name), px_text(c.pixels),
                       percent_text(ratio(c.pixels, totals.wrong)));
  }
  return out + "</ul></div>\n";
}

// The largest confusions twice: those that cost most pixels are of large classes, those that hide a class of small
// ones.
std::string confusions_in_words(const FinalEval& eval, const Totals& totals) {
  std::vector<Confusion> found;
  for (std::size_t t = 0; t < eval.classes.size(); ++t) {
    for (std::size_t p = 0; p < eval.classes.size(); ++p) {
      if (t != p && eval.count(t, p) > 0)
        found.push_back({t, p, eval.count(t, p), ratio(eval.count(t, p), totals.truth[t])});
    }
  }
  if (found.empty()) return "<p class=\"hint\">Every scored pixel has its class.</p>\n";
  std::stable_sort(found.begin(), found.end(),
                   [](const Confusion& a, const Confusion& b) { return a.pixels > b.pixels; });
  const std::string by_pixels = words_list(eval, totals, "Most pixels", found);
  std::stable_sort(found.begin(), found.end(),
                   [](const Confusion& a, const Confusion& b) { return a.share > b.share; });
  return "<div class=\"words\">\n" + by_pixels + words_list(eval, totals, "Largest share of a class", found) +
         "</div>\n";
}

std::string confusion_cell(const FinalEval& eval, const Totals& totals, std::size_t t, std::size_t p) {
  const std::int64_t pixels = eval.count(t, p);
  if (pixels == 0) return "<td></td>";
  const double share = ratio(pixels, totals.truth[t]);
  // The root shows small fractions; half of full colour keeps the figures legible.
  return fmt::format("<td class=\"{}\" style=\"--p:{:.0f}%\" title=\"{} read as {}: {} of {}, {}\">{}</td>",
                     t == p ? "ok" : "no", 60 * std::sqrt(share), html_escape(eval.classes[t].name),
                     html_escape(eval.classes[p].name), percent_text(share), html_escape(eval.classes[t].name),
                     px_text(pixels), share < 0.005 ? "·" : fmt::format("{:.0f}", 100 * share));
}

// Classes shown, by position: all, or those with most pixels in truth and prediction.
std::vector<std::size_t> shown_classes(const Totals& totals) {
  std::vector<std::size_t> shown(totals.truth.size());
  std::iota(shown.begin(), shown.end(), std::size_t{0});
  if (shown.size() <= kMostClasses) return shown;
  std::stable_sort(shown.begin(), shown.end(), [&](std::size_t a, std::size_t b) {
    return totals.truth[a] + totals.predicted[a] > totals.truth[b] + totals.predicted[b];
  });
  shown.resize(kMostClasses);
  std::sort(shown.begin(), shown.end());
  return shown;
}

std::string confusion_table(const FinalEval& eval, const Totals& totals) {
  const std::vector<std::size_t> shown = shown_classes(totals);
  std::string head = "<tr><th scope=\"col\" class=\"row\">truth ↓ read as →</th>", body;
  for (const std::size_t p : shown) {
    const FinalEval::Class& c = eval.classes[p];
    head += fmt::format("<th scope=\"col\" title=\"{}\"><span class=\"v\">{}{} {}</span></th>", html_escape(c.name),
                        swatch(c.color), c.id, html_escape(c.name));
  }
  head += "<th scope=\"col\" class=\"num\">pixels</th></tr>";
  for (const std::size_t t : shown) {
    if (totals.truth[t] == 0) continue;  // read, but never true: a column alone
    const FinalEval::Class& c = eval.classes[t];
    body += fmt::format("<tr><th scope=\"row\" class=\"row\" title=\"{}\">{}<span class=\"none\">{}</span> {}</th>",
                        html_escape(c.name), swatch(c.color), c.id, html_escape(c.name));
    for (const std::size_t p : shown) body += confusion_cell(eval, totals, t, p);
    body += fmt::format("<td class=\"num\">{}</td></tr>\n", count_text(totals.truth[t]));
  }
  std::string out =
      "<div class=\"scroll\" tabindex=\"0\" role=\"region\" aria-label=\"Confusion matrix\"><table "
      "class=\"cm\">\n<thead>" +
      head + "</thead>\n<tbody>\n" + body + "</tbody></table></div>\n";
  if (shown.size() < eval.classes.size()) {
    out += fmt::format(
        "<p class=\"hint after\">The {} of {} classes with the most pixels; `semfield eval --json` prints all.</p>\n",
        shown.size(), eval.classes.size());
  }
  return out;
}

// "over-confident by 3 %".
std::string lean_text(const FinalEval& eval) {
  double pixels = 0, confidence = 0, accuracy = 0;
  for (const FinalEval::Bin& bin : eval.bins) {
    pixels += static_cast<double>(bin.pixels);
    confidence += static_cast<double>(bin.pixels) * bin.confidence;
    accuracy += static_cast<double>(bin.pixels) * bin.accuracy;
  }
  const double lean = pixels > 0 ? (confidence - accuracy) / pixels : 0;
  const std::string means = fmt::format("Mean confidence {:.3f}, accuracy {:.3f}", confidence / std::max(1.0, pixels),
                                        accuracy / std::max(1.0, pixels));
  if (std::abs(lean) < 0.0005) return means;
  return fmt::format("{}: {} by {:.3f}", means, lean > 0 ? "over-confident" : "under-confident", std::abs(lean));
}

// What entropy says of wrong labels; empty in files of versions that did not count it.
std::string entropy_text(const FinalEval& eval) {
  if (!eval.entropy_auroc) return {};
  return fmt::format(" AUROC {}: in {} of all pairs of a wrong and a right pixel the wrong one has the higher entropy.",
                     figure_text(eval.entropy_auroc->value, 3), percent_text(eval.entropy_auroc->value));
}

std::string reliability(const ReportRun& run, int color) {
  const FinalEval& eval = *run.eval;
  std::int64_t all = 0;
  for (const FinalEval::Bin& bin : eval.bins) all += bin.pixels;
  PlotSpec spec{"Accuracy", "confidence", false, true, 3, {{run.name, color, {}}}};
  spec.x_range = spec.y_range = PlotRange{0, 1};
  spec.end_values = false;
  PlotSeries& series = spec.series.front();
  std::string rows;
  const auto bins = static_cast<double>(eval.bins.size());
  for (std::size_t b = 0; b < eval.bins.size(); ++b) {
    const FinalEval::Bin& bin = eval.bins[b];
    if (bin.pixels == 0) continue;
    const double from = static_cast<double>(b) / bins, to = static_cast<double>(b + 1) / bins,
                 share = ratio(bin.pixels, all);
    series.points.push_back({bin.confidence, bin.accuracy});
    series.bars.push_back({from, to, share,
                           fmt::format("confidence {:.2f} to {:.2f}: {} of the pixels, accuracy {:.3f}", from, to,
                                       percent_text(share), bin.accuracy)});
    rows += fmt::format(
        "<tr><th scope=\"row\">{:.2f} to {:.2f}</th><td class=\"num\">{}</td><td class=\"num\">{}</td><td "
        "class=\"num\">{:.3f}</td><td class=\"num\">{:.3f}</td><td class=\"num\">{}</td></tr>\n",
        from, to, count_text(bin.pixels), percent_text(share), bin.confidence, bin.accuracy,
        figure_text(std::round(1000 * (bin.accuracy - bin.confidence)) / 1000, 3));
  }
  spec.series.push_back({"perfect calibration", 0, {{0, 0}, {1, 1}}});
  spec.series.back().reference = true;
  const std::optional<double> ece = eval.ece();
  return fmt::format(
      "<figure class=\"panel\"><figcaption>{}<span>{}</span></figcaption>\n{}<p class=\"hint "
      "note\">{}.{}</p>\n<details><summary>Bins</summary><div class=\"scroll\" tabindex=\"0\" role=\"region\" "
      "aria-label=\"Reliability bins\"><table><thead><tr><th scope=\"col\">Confidence</th><th scope=\"col\" "
      "class=\"num\">Pixels</th>"
      "<th scope=\"col\" class=\"num\">Share</th><th scope=\"col\" class=\"num\">Mean confidence</th><th scope=\"col\" "
      "class=\"num\">Accuracy</th><th scope=\"col\" class=\"num\">Accuracy − "
      "confidence</th></tr></thead>\n<tbody>\n{}</tbody></table></div></details></figure>\n",
      html_escape(run.name),
      ece ? "ECE " + figure_text(*ece, 3)
          : fmt::format("no ECE: {} without finite probabilities", px_text(eval.nonfinite_px)),
      line_plot(spec), lean_text(eval), entropy_text(eval), rows);
}

// Entropy at training poses by what the label was worth, of runs with report.training_frames.
std::string given_table(const ReportInput& input) {
  struct Column {
    const char *head, *hint, *key;
  };
  constexpr Column kColumns[] = {{"Labelled rightly", "mean entropy, nats", "given_right_entropy"},
                                 {"Labelled wrongly", "mean entropy, nats", "given_wrong_entropy"},
                                 {"Unlabelled", "mean entropy, nats", "given_none_entropy"},
                                 {"Wrong against right", "AUROC of entropy", "given_wrong_auroc"},
                                 {"Unlabelled against labelled", "AUROC of entropy", "given_none_auroc"}};
  std::string head = "<tr><th scope=\"col\">Run</th>", body;
  for (const Column& c : kColumns)
    head += fmt::format("<th scope=\"col\" class=\"num\">{}<small class=\"d\">{}</small></th>", c.head, c.hint);
  for (const ReportRun& run : input.runs) {
    std::string cells;
    bool any = false;
    for (const Column& c : kColumns) {
      const std::optional<double> value = last_value(run, "train", c.key);
      any = any || value;
      cells += value_cell(value, 3, false);
    }
    if (any) body += fmt::format("<tr><th scope=\"row\">{}</th>{}</tr>\n", html_escape(run.name), cells);
  }
  if (body.empty()) return {};
  return "<p class=\"hint after\">Entropy of the pixels of training frames, by the label that they were given. An "
         "AUROC of 0.5 is chance; 1 means that entropy separates the two groups.</p>\n" +
         table_panel("Entropy by the label given", head + "</tr>", body);
}

// Worst first; frames without a mIoU after those with one, by PSNR.
std::vector<const FrameScore*> by_miou(const FinalEval& eval) {
  std::vector<const FrameScore*> order;
  for (const FrameScore& frame : eval.frames) order.push_back(&frame);
  const auto key = [](const FrameScore* f) {
    return std::pair(f->miou_present.value_or(2), f->psnr_db.value_or(INFINITY));
  };
  std::stable_sort(order.begin(), order.end(),
                   [&](const FrameScore* a, const FrameScore* b) { return key(a) < key(b); });
  return order;
}

std::string frames_table(const ReportRun& run, bool several) {
  std::string body;
  for (const FrameScore* frame : by_miou(*run.eval)) {
    body += fmt::format("<tr><th scope=\"row\">{}</th>{}{}{}</tr>\n", html_escape(frame->name),
                        value_cell(frame->miou_present, 4, false), value_cell(frame->psnr_db, 4, false),
                        value_cell(frame->absrel, 3, false));
  }
  return fmt::format(
      "<details><summary>Scores of all {} frames{}</summary><div class=\"scroll\" tabindex=\"0\" role=\"region\" "
      "aria-label=\"Scores of frames\"><table><thead><tr><th scope=\"col\">Frame</th><th scope=\"col\" "
      "class=\"num\">mIoU (present)</th>"
      "<th scope=\"col\" class=\"num\">PSNR, dB</th><th scope=\"col\" "
      "class=\"num\">AbsRel</th></tr></thead>\n<tbody>\n{}</tbody></table></div></details>\n",
      run.eval->frames.size(), several ? ": " + html_escape(run.name) : "", body);
}

}  // namespace

std::string confusion_section(const ReportInput& input) {
  std::string body;
  const bool several = input.runs.size() > 1;
  for (const ReportRun& run : input.runs) {
    if (!run.eval || run.eval->classes.empty()) continue;
    const Totals totals(*run.eval);
    if (totals.all == 0) continue;
    const std::string matrix = confusions_in_words(*run.eval, totals) + confusion_table(*run.eval, totals);
    body += several ? fmt::format("<details{}><summary>{}</summary>\n{}</details>\n", body.empty() ? " open" : "",
                                  html_escape(run.name), matrix)
                    : "<div class=\"pad\">" + matrix + "</div>\n";
  }
  if (body.empty()) return {};
  return open_section("confusion", "Confusions",
                      "Which classes are taken for which, over all pixels of the last evaluation. A row holds all "
                      "pixels of a true class and sums to 100 %; “·” is less than half a per cent.") +
         "<div class=\"panel\">\n" + body + "</div>\n" + missing_runs(input, kNoDetail, without_detail) +
         "</section>\n";
}

std::string calibration_section(const ReportInput& input) {
  std::string figures;
  for (std::size_t i = 0; i < input.runs.size(); ++i) {
    const ReportRun& run = input.runs[i];
    if (run.eval && !run.eval->bins.empty()) figures += reliability(run, static_cast<int>(i));
  }
  const std::string given = given_table(input);
  if (figures.empty() && given.empty()) return {};
  return open_section(
             "calibration", "Calibration",
             "Does a class with probability 0.8 turn out right in 80 % of the cases? Dots: share of right pixels over "
             "mean confidence, in 15 bins; on the dotted line it is as sure as it is right, below it too sure. "
             "Bars: share of all pixels that a bin holds. ECE is the mean distance from the line, weighted by "
             "pixels. AUROC says how well entropy finds wrong pixels: 0.5 is chance, 1 is all wrong pixels above all "
             "right ones.") +
         "<div class=\"plots\">\n" + figures + "</div>\n" + given + missing_runs(input, kNoDetail, without_detail) +
         "</section>\n";
}

std::string worst_section(const ReportInput& input, const std::string& of_first) {
  std::string tables;
  for (const ReportRun& run : input.runs) {
    if (run.eval && !run.eval->frames.empty()) tables += frames_table(run, input.runs.size() > 1);
  }
  if (input.worst.empty() && tables.empty()) return {};
  if (!tables.empty()) tables = "<div class=\"panel below\">\n" + tables + "</div>\n";
  return open_section("worst", "Worst frames",
                      input.worst.empty() ? "" : "The frames with the lowest scores, worst first." + of_first) +
         strip_panels(input.worst) + tables + "</section>\n";
}

}  // namespace semfield
