// The report's sections that compare runs and look into their last evaluation, held against hand-made inputs.
#include "report/report_sections.h"

#include <filesystem>

#include "core/error.h"
#include "report/report.h"
#include "system/files.h"
#include "tests/says.h"

namespace semfield {
namespace {

std::size_t count_of(const std::string& text, const std::string& part) {
  std::size_t count = 0;
  for (std::size_t at = text.find(part); at != std::string::npos; at = text.find(part, at + 1)) ++count;
  return count;
}

TEST(Convergence, IsReadFromStraightLinesBetweenPoints) {
  const std::vector<PlotPoint> rise{{10, 20}, {20, 28}, {40, 30}};  // 90 %: 29, 95 %: 29.5
  EXPECT_DOUBLE_EQ(*time_to_share(rise, 1, 0.9), 30);
  EXPECT_DOUBLE_EQ(*time_to_share(rise, 1, 0.95), 35);
  EXPECT_DOUBLE_EQ(*time_to_share(rise, 1, 0), 10);
  EXPECT_DOUBLE_EQ(*time_to_share(rise, 1, 1), 40);
  const std::vector<PlotPoint> fall{{1, 0.5}, {2, 0.1}, {3, 0.1}};  // the level 0.14 lies on the first segment
  EXPECT_NEAR(*time_to_share(fall, -1, 0.9), 1.9, 1e-12);
}

TEST(Convergence, NoiseCountsFromTheFirstCrossing) {
  // Beyond the last value, back below 90 % of the way, and up again: the first crossing of 9 counts.
  const std::vector<PlotPoint> noisy{{0, 0}, {1, 12}, {2, 5}, {3, 10}};
  EXPECT_DOUBLE_EQ(*time_to_share(noisy, 1, 0.9), 0.75);
}

TEST(Convergence, IsNoneWhereThereIsNoWay) {
  EXPECT_FALSE(time_to_share({}, 1, 0.9).has_value());
  EXPECT_FALSE(time_to_share({{5, 30}}, 1, 0.9).has_value()) << "a single point";
  EXPECT_FALSE(time_to_share({{5, 30}, {6, 40}, {7, 30}}, 1, 0.9).has_value()) << "ends where it began";
  EXPECT_FALSE(time_to_share({{5, 30}, {6, 20}}, 1, 0.9).has_value()) << "ends worse than it began";
  EXPECT_TRUE(time_to_share({{5, 30}, {6, 20}}, -1, 0.9).has_value());
  EXPECT_FALSE(time_to_share({{5, 30}, {6, INFINITY}}, 1, 0.9).has_value()) << "one finite point";
}

MetricsRow eval_row(double train_s, double psnr, double miou) {
  MetricsRow row;
  row.kind = "eval";
  row.split = "test";
  row.step = static_cast<std::int64_t>(train_s);
  row.train_s = train_s;
  row.set("psnr", psnr);
  row.set("miou", miou);
  row.set("miou_present", miou);
  row.set("total_accuracy", miou + 0.1);
  return row;
}

ReportRun run_named(const std::string& name) {
  return ReportRun{.name = name, .rows = {eval_row(10, 20, 0.2), eval_row(20, 28, 0.6), eval_row(40, 30, 0.7)}};
}

LabelCounts labels_of(std::int64_t frames) {
  return {
      200, frames, 3840000, frames * 19200, {{1, "wall", frames * 19000}, {2, "clock", frames * 200}, {3, "mug", 0}},
      {}};
}

// wall: 80 right, 20 as chair & co; chair <b>: 30 as wall, 10 right; table: predicted alone.
FinalEval eval_of() {
  FinalEval eval{.split = "test",
                 .classes = {{1, "wall", {196, 200, 208}}, {4, "chair <b>", {1, 2, 3}}, {9, "table", {4, 5, 6}}},
                 .confusion = {80, 15, 5, 30, 10, 0, 0, 0, 0}};
  eval.bins.resize(15);
  eval.bins[7] = {25, 0.5, 0.6};
  eval.bins[14] = {75, 0.98, 0.9};
  FrameScore a, b, c;
  a.name = "good";
  a.miou_present = 0.9;
  a.psnr_db = 30;
  b.name = "bad & worse";
  b.miou_present = 0.1;
  b.psnr_db = 31;
  c.name = "unlabelled";
  c.psnr_db = 10;
  eval.frames = {a, b, c};
  return eval;
}

TEST(CurvesSection, MarksAndTabulatesTheTimes) {
  ReportInput input{.runs = {run_named("a")}};
  const std::string html = curves_section(input, "test");
  EXPECT_HAS(html,
             "<td class=\"num\">30.00<small class=\"d\">from 20.00</small></td><td class=\"num\">30.0 s</td><td "
             "class=\"num\">35.0 s</td>",
             "<title>a: 90 % of the way after 30.0 s</title>");
  EXPECT_EQ(count_of(html, "class=\"mk\""), 4u) << "two marks in each of two plots";
  EXPECT_LACKS(html, "log-time") << "10 s to 40 s is less than a decade";
  input.runs[0].rows.insert(input.runs[0].rows.begin(), eval_row(1, 10, 0.1));
  EXPECT_HAS(curves_section(input, "test"), "log-time");
  input.runs[0].rows.resize(1);
  const std::string single = curves_section(input, "test");
  EXPECT_HAS(single,
             "<td class=\"num\">10.00<small class=\"d\">from 10.00</small></td><td class=\"num none\">–</td><td "
             "class=\"num none\">–</td>");
  EXPECT_EQ(count_of(single, "class=\"mk\""), 0u);
}

TEST(CurvesSection, DrawsEachTermOfTheLossByName) {
  ReportInput input{.runs = {run_named("a")}};
  EXPECT_LACKS(curves_section(input, "test"), "Loss: ");
  for (int step = 1; step <= 3; ++step) {
    MetricsRow row{.step = step, .train_s = 10.0 * step};
    row.set("loss", 0.5);
    row.set("loss_color", 0.2);
    row.set("loss_semantic", 0.1);
    row.set("loss_depth", 0.4 / step);
    row.set("loss_distortion", step == 1 ? std::nullopt : std::optional(0.1));
    input.runs[0].rows.push_back(row);
  }
  const std::string html = curves_section(input, "test");
  EXPECT_HAS(html, "<figcaption>Loss: depth<span>logarithmic, before its weight</span>",
             "<figcaption>Loss: distortion<span>");
  EXPECT_EQ(count_of(html, "<figcaption>Loss: "), 2u) << "colour and semantics are in the training loss";
}

TEST(LabelsSection, ShowsRunsThatKnowTheirLabelsAndNamesTheOthers) {
  ReportInput input{.runs = {run_named("few"), run_named("many"), run_named("<old>")}};
  EXPECT_EQ(labels_section(input, "test"), "") << "no run knows its labels";
  input.runs[0].labels = labels_of(4);
  EXPECT_HAS(labels_section(input, "test"), "Labels in training") << "one run is a table, no plot";
  EXPECT_LACKS(labels_section(input, "test"), "<svg viewBox=\"0 0 540");
  input.runs[1].labels = labels_of(100);
  const std::string html = labels_section(input, "test");
  EXPECT_HAS(html, "4 of 200", "1,920,000<small class=\"d\">50 % of all");
  EXPECT_HAS(html, "2 of 3") << "classes with labels";
  EXPECT_EQ(count_of(html, "<svg viewBox=\"0 0 540"), 4u) << "two metrics over pixels and over frames";
  EXPECT_HAS(html, "logarithmic number of labels", "few: 0.700 at 76800", "many: 0.700 at 100",
             "older version): &lt;old&gt;.</p>");
  for (const auto& [run, pixels] : {std::pair{0, 900}, {1, 300}}) input.runs[run].rows.back().set("pixels", pixels);
  EXPECT_LACKS(labels_section(input, "test"), "<svg viewBox=\"0 0 540") << "scored on other pixels";
}

TEST(LabelsSection, SaysWhatWasDoneToLabelsAndWhatTheyWereWorth) {
  ReportInput input{.runs = {run_named("noisy")}};
  input.runs[0].labels = labels_of(4);
  EXPECT_LACKS(labels_section(input, "test"), "mIoU of the labels");
  input.runs[0].labels->steps = {{"pixel_noise", {{"pixels changed", "<12>"}, {"share", "0.5"}}}, {"propagate", {}}};
  MetricsRow train{.kind = "eval"};
  train.split = "train";
  train.set("given_miou", 0.345);
  train.set("miou", 0.812);
  input.runs[0].rows.push_back(train);
  const std::string html = labels_section(input, "test");
  EXPECT_HAS(html, "noisy<small class=\"d\">pixel_noise, propagate</small>",
             ">noisy, pixel_noise: pixels changed &lt;12&gt;, share 0.5.</p>",
             "<td class=\"num\">0.7000</td><td class=\"num\">0.8000</td><td class=\"num\">0.3450</td><td "
             "class=\"num\">0.8120</td>");
  EXPECT_EQ(report_split(input.runs[0].rows), "test") << "the page is about held-out frames";
  EXPECT_EQ(report_split({train}), "train");
}

TEST(LabelsSection, NoLabelAtAllIsNoLogarithm) {
  ReportInput input{.runs = {run_named("none"), run_named("many")}};
  input.runs[0].labels = labels_of(0);
  input.runs[1].labels = labels_of(100);
  const std::string html = labels_section(input, "test");
  EXPECT_LACKS(html, "logarithmic", "nan", "inf");
}

TEST(ConfusionSection, NormalisesRowsAndSaysTheLargest) {
  ReportInput input{.runs = {run_named("a")}};
  EXPECT_EQ(confusion_section(input), "");
  input.runs[0].eval = eval_of();
  const std::string html = confusion_section(input);
  EXPECT_HAS(html, "chair &lt;b&gt; read as ");
  EXPECT_LACKS(html, "<b>");
  EXPECT_HAS(html, "</span>wall: 75 % of chair &lt;b&gt;<small class=\"d\">30 px, 60 % of all wrong pixels</small>");
  EXPECT_HAS(html, ">80</td>");  // of 100 pixels of wall
  EXPECT_HAS(html, ">75</td>");  // 30 of 40 pixels of chair
  EXPECT_EQ(count_of(html, "<th scope=\"row\""), 2u) << "a class that is never true has a column and no row";
  EXPECT_EQ(count_of(html, "class=\"v\""), 3u);
  EXPECT_HAS(html, "</span>9 table</span>") << "ids beside names";
  input.runs.push_back(run_named("old"));
  const std::string two = confusion_section(input);
  EXPECT_HAS(two, "<details open><summary>a</summary>", "not ended): old.</p>");
}

TEST(ConfusionSection, KeepsTheLargestOfManyClasses) {
  FinalEval eval;
  constexpr std::size_t kClasses = 70;
  eval.confusion.assign(kClasses * kClasses, 0);
  for (std::size_t c = 0; c < kClasses; ++c) {
    eval.classes.push_back({static_cast<std::int32_t>(c), "class" + std::to_string(c), {}});
    eval.confusion[c * kClasses + c] = static_cast<std::int64_t>(c + 1);
  }
  ReportInput input{.runs = {run_named("a")}};
  input.runs[0].eval = eval;
  const std::string html = confusion_section(input);
  EXPECT_EQ(count_of(html, "class=\"v\""), 64u);
  EXPECT_LACKS(html, "5 class5<") << "the six with fewest pixels are not shown";
  EXPECT_HAS(html, "6 class6<", "The 64 of 70 classes with the most pixels", "Every scored pixel has its class.");
}

TEST(CalibrationSection, DrawsBinsAndTheirShares) {
  ReportInput input{.runs = {run_named("a")}};
  EXPECT_EQ(calibration_section(input), "");
  input.runs[0].eval = eval_of();
  const std::string html = calibration_section(input);
  EXPECT_HAS(html, "ECE 0.0850") << "0.25 * 0.1 + 0.75 * 0.08";
  EXPECT_EQ(count_of(html, "class=\"br\""), 2u);
  EXPECT_EQ(count_of(html, "class=\"rf\""), 1u);
  EXPECT_HAS(html, "<title>a: 0.600 at 0.500</title>", "confidence 0.93 to 1.00: 75 % of the pixels, accuracy 0.900",
             "Mean confidence 0.860, accuracy 0.825: over-confident by 0.035", "<td class=\"num\">−0.0800</td>");
  input.runs[0].eval->nonfinite_px = 1200;
  EXPECT_HAS(calibration_section(input), "no ECE: 1,200 px without finite probabilities");
}

TEST(CalibrationSection, SaysWhatEntropyTellsOfWrongPixelsAndOfTheLabelsGiven) {
  ReportInput input{.runs = {run_named("<a>"), run_named("b")}};
  MetricsRow train{.kind = "eval", .split = "train_sample"};
  train.set("frames", 10);
  train.set("split_frames", 120);
  train.set("given_right_entropy", 0.125);
  train.set("given_wrong_entropy", 0.75);
  train.set("given_wrong_auroc", 0.875);
  train.set("given_none_entropy", std::nullopt);
  input.runs[0].rows.push_back(train);
  const std::string alone = calibration_section(input);
  EXPECT_HAS(alone, "id=\"calibration\"") << "without held-out frames, training frames tell something";
  EXPECT_LACKS(alone, "AUROC 0.");
  input.runs[0].eval = eval_of();
  EXPECT_LACKS(calibration_section(input), "AUROC 0.") << "a file of an earlier version";
  input.runs[0].eval->entropy_auroc = {0.9125, 0.001};
  const std::string html = calibration_section(input);
  EXPECT_HAS(html,
             "AUROC 0.912: in 91 % of all pairs of a wrong and a right pixel the wrong one has the higher entropy.",
             "<th scope=\"row\">&lt;a&gt;</th><td class=\"num\">0.125</td><td class=\"num\">0.750</td><td "
             "class=\"num none\">–</td><td class=\"num\">0.875</td><td class=\"num none\">–</td>");
  EXPECT_LACKS(html, "<th scope=\"row\">b</th>") << "it scored no training frames";
}

TEST(ClicksSection, ShowsClassesClicksAndPictures) {
  ReportInput input;
  input.runs.push_back({"room", {}, "", "", {}, {}, {}, {}, {}});
  EXPECT_EQ(clicks_section(input, ""), "") << "nothing was clicked";
  input.runs[0].clicked = LabellingRecord{
      900,         17, 3, 20, {{1, "wa<ll", {10, 20, 30}, 12, 0.4, 0.93}, {7, "cup", {200, 0, 0}, 5, 0.0004, 0.5}},
      {{"f/2", 9}}};
  input.clicked.push_back({"f/2", "9 clicks", {{"photograph, clicks", {1, 2, 3}}, {"label, rendered", {4, 5, 6}}}});
  const std::string html = clicks_section(input, "");
  EXPECT_HAS(html, "17 clicks in 3 of 20 frames, at step 900", "wa&lt;ll", "rgb(10 20 30)",
             "<td class=\"num\">12</td><td class=\"num\">40 %</td><td class=\"num\">93 %</td>", "under 0.1 %");
  EXPECT_EQ(count_of(html, "<img "), 2u);
  EXPECT_HAS(make_report(input), "<a href=\"#clicks\">Clicks</a>");
  const std::string json = labelling_record_json(*input.runs[0].clicked);
  EXPECT_EQ(parse_labelling_record(json, "x"), *input.runs[0].clicked);
  EXPECT_THROW((void)parse_labelling_record("{}", "x"), Error);
  const std::pair<std::string, std::string> bad[] = {{"\"step\": 900", "\"step\": -1"},
                                                     {"\"clicks\": 17", "\"clicks\": 1e+30"},
                                                     {"\"frames\": 20", "\"frames\": 1.5"},
                                                     {"\"id\": 7", "\"id\": 4294967303"},
                                                     {"200,", "300,"},
                                                     {"\"clicks\": 9", "\"clicks\": -9"}};
  for (const auto& [good, other] : bad) {
    std::string changed = json;
    ASSERT_NE(changed.find(good), std::string::npos) << good;
    changed.replace(changed.find(good), good.size(), other);
    EXPECT_ERROR(parse_labelling_record(changed, "labelling.json"), "run.record.damaged", "labelling.json");
  }
}

TEST(WorstSection, ListsEveryFrameByItsScore) {
  ReportInput input{.runs = {run_named("a")}};
  EXPECT_EQ(worst_section(input, ""), "");
  input.runs[0].eval = eval_of();
  const std::string html = worst_section(input, "");
  EXPECT_HAS(html, "Scores of all 3 frames");
  const std::size_t bad = html.find("bad &amp; worse"), good = html.find(">good<"), none = html.find(">unlabelled<");
  EXPECT_LT(bad, good);
  EXPECT_LT(good, none) << "a frame without a mIoU comes after those with one";
}

TEST(Report, RunFoldersWithAndWithoutTheNewFiles) {
  std::string root = (std::filesystem::temp_directory_path() / "semfield_sections_XXXXXX").string();
  ASSERT_NE(::mkdtemp(root.data()), nullptr);
  std::vector<std::string> folders;
  for (const char* name : {"new", "old"}) {
    const RunFolder folder = RunFolder::create(root + "/" + name);
    write_file_atomic(folder.config_path(), "seed: 1\n");
    MetricsLog log = MetricsLog::create(folder.metrics_path());
    for (const MetricsRow& row : run_named(name).rows) log.append(row);
    folders.push_back(root + "/" + name);
  }
  const RunFolder fresh = RunFolder::read(folders[0]);
  write_file_atomic(fresh.labels_path(), label_counts_json(labels_of(20)));
  write_file_atomic(fresh.final_eval_path(), final_eval_json(eval_of()));
  const std::string page = make_report(read_report_input(folders));
  EXPECT_HAS(page, "id=\"labels\"", "id=\"confusion\"", "id=\"calibration\"", "id=\"worst\"",
             "no labels.json (made by an older version): old.", "href=\"#calibration\"");
  EXPECT_TRUE(page == make_report(read_report_input(folders))) << "the same files give the same bytes";
  const std::string old_page = make_report(read_report_input({folders[1]}));
  EXPECT_LACKS(old_page, "id=\"labels\"", "id=\"confusion\"", "id=\"calibration\"", "id=\"worst\"");
  write_file_atomic(fresh.final_eval_path(), "{\"split\": \"test\"}");
  try {
    (void)read_report_input(folders);
    FAIL() << "a broken file is accepted";
  } catch (const Error& e) {
    EXPECT_HAS(e.what(), "final_eval.json");
  }
  std::filesystem::remove_all(root);
}

}  // namespace
}  // namespace semfield
