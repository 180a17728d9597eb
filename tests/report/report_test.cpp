// The report: well-formed, self-contained, byte-identical, escaped; and the plots and text pieces it is made of.

#include "report/report.h"

#include <cstdlib>
#include <filesystem>
#include <tuple>

#include "core/error.h"
#include "eval/image_output.h"
#include "formats/image_io.h"
#include "report/html.h"
#include "report/report_comparison.h"
#include "report/report_sections.h"
#include "system/files.h"
#include "tests/says.h"
#include "tests/temp_dir.h"

namespace semfield {
namespace {

namespace fs = std::filesystem;

const std::vector<ReportClass> kClasses{{"wall", {174, 199, 232}},    {"floor", {152, 223, 138}},
                                        {"chair", {188, 189, 34}},    {"table", {255, 152, 150}},
                                        {"lamp <b>", {96, 207, 209}}, {"cushion", {112, 128, 144}}};

// A course of training that ends at `psnr_end` with time constant `tau_s`.
ReportRun sample_run(const std::string& name, double psnr_end, double tau_s, double seconds) {
  ReportRun run{.name = name};
  for (std::int64_t step = 10; step <= 6000; step += 10) {
    MetricsRow row{.step = step, .train_s = seconds * static_cast<double>(step) / 6000};
    const double noise = 0.12 * std::sin(static_cast<double>(step * step % 977));
    row.set("loss", std::exp(noise) * (0.004 + 0.25 * std::exp(-row.train_s / tau_s)));
    row.set("rays_per_s", 41230.0);
    run.rows.push_back(row);
    if (step % 500 != 0) continue;
    MetricsRow eval;
    eval.kind = "eval";
    eval.split = "test";
    eval.step = step;
    eval.train_s = row.train_s;
    const double done = 1 - std::exp(-row.train_s / tau_s);
    eval.set("psnr", 12 + (psnr_end - 12) * done);
    eval.set("ssim", 0.4 + 0.5 * done);
    eval.set("miou", 0.85 * done);
    eval.set("miou_present", 0.88 * done);
    eval.set("total_accuracy", 0.4 + 0.57 * done);
    eval.set("absrel", 0.02 + 0.6 * (1 - done));
    for (std::size_t c = 0; c < kClasses.size(); ++c)
      eval.per_class_iou.emplace_back(
          kClasses[c].name, c == 4 ? std::nullopt : std::optional(done * (0.95 - 0.13 * static_cast<double>(c))));
    run.rows.push_back(eval);
  }
  run.config = "scene: {type: replica}\n# <script>alert(1)</script>\n";
  run.environment = {{"compiler", "g++ 12.2.0"}, {"cpu", "A & B"}, {"seed", "1"}, {"input_hash", ""}};
  run.left_out = {{"depth loss", "no depth weight", "lambda_d = 0", "B", "4 B per pixel", ""}};
  return run;
}

ReportImage sample_image(const std::string& caption, int kind) {
  constexpr int kWidth = 96, kHeight = 72;
  std::vector<std::uint8_t> rgb;
  for (int y = 0; y < kHeight; ++y) {
    for (int x = 0; x < kWidth; ++x) {
      const double t = std::hypot(x - 40, y - 30) / 70;
      const auto map = perceptual_color(kind % 2 == 0 ? 1 - t : t * t);
      const auto& flat = kClasses[(x / 24 + y / 30) % 4].color;
      rgb.insert(rgb.end(), kind >= 4 ? map.begin() : flat.begin(), kind >= 4 ? map.end() : flat.end());
    }
  }
  return {caption, encode_png_rgb(kWidth, kHeight, rgb)};
}

ReportInput sample_input(int runs) {
  ReportInput input{
      .title = "Room 0 & friends",
      .subtitle = "Replica layout, 18 training and 18 test frames, labels on 10 % of the training frames"};
  input.runs.push_back(sample_run("hash_grid", 31.4, 22, 95));
  if (runs > 1) input.runs.push_back(sample_run("frequency", 29.6, 90, 310));
  if (runs > 2) input.runs.push_back(sample_run("identity", 18, 120, 250));
  input.classes = kClasses;
  int kind = 0;
  ReportStrip strip{"0017", "mIoU 0.81, PSNR 30.9 dB", {}};
  for (const char* caption :
       {"colour, truth", "colour, rendered", "label, truth", "label, rendered", "entropy", "depth"})
    strip.images.push_back(sample_image(caption, kind++));
  input.strips.push_back(strip);
  strip.name = "0042";
  strip.note = "mIoU 0.31";
  input.worst.push_back(strip);
  return input;
}

// Every tag that must be closed is, in order. Returns the first fault, or "".
std::string unbalanced(const std::string& html) {
  static const std::set<std::string> kVoid{"meta", "img", "input", "!DOCTYPE"};
  std::vector<std::string> open;
  for (std::size_t at = html.find('<'); at != std::string::npos; at = html.find('<', at + 1)) {
    const std::size_t end = html.find('>', at);
    if (end == std::string::npos) return "an open tag";
    const std::string tag = html.substr(at + 1, end - at - 1);
    const std::string name = tag.substr(tag[0] == '/' ? 1 : 0, tag.find_first_of(" \n/", 1) - (tag[0] == '/' ? 1 : 0));
    if (tag[0] == '/') {
      if (open.empty() || open.back() != tag.substr(1))
        return "</" + tag.substr(1) + "> after <" + (open.empty() ? "" : open.back()) + ">";
      open.pop_back();
    } else if (!kVoid.contains(name) && tag.back() != '/') {
      open.push_back(name);
    }
  }
  return open.empty() ? "" : "<" + open.back() + "> stays open";
}

std::size_t count_of(const std::string& text, const std::string& part) {
  std::size_t count = 0;
  for (std::size_t at = text.find(part); at != std::string::npos; at = text.find(part, at + 1)) ++count;
  return count;
}

TEST(Report, HoldsThePageOfASceneAndRunsItsScriptAlone) {
  ReportInput input = sample_input(1);
  input.scene = "<!doctype html><p>\"A & B\"</p><script type=\"text/plain\">no</script><script>abc</script>";
  const std::string page = make_report(input);
  EXPECT_EQ(unbalanced(page), "");
  EXPECT_LACKS(page, "<script");
  EXPECT_HAS(page, "&quot;A &amp; B&quot;", "sha256-ungWv48Bz+pBQUDeXa4iI7ADYaOWF3qctBD/YfIAFa0=");  // "abc" [FIPS180]
  EXPECT_LACKS(make_report(sample_input(1)), "<iframe", "script-src", "#scene");
}

TEST(Report, IsWellFormedAndSelfContained) {
  for (int runs : {1, 2, 3}) {
    const std::string page = make_report(sample_input(runs));
    EXPECT_EQ(unbalanced(page), "") << runs;
    EXPECT_LACKS(page, "<script", "http://", "https://", "src=\"/", "url(", "@import", "<link");
    EXPECT_EQ(count_of(page, "<polyline"),
              2 * 4u * static_cast<std::size_t>(runs));  // each run in each plot, over linear and logarithmic time
    EXPECT_EQ(count_of(page, "data:image/png;base64,"), 12u);
    EXPECT_EQ(count_of(page, "<img alt=\""), 12u);
    EXPECT_HAS(page, "lamp &lt;b&gt;");
    EXPECT_LACKS(page, "lamp <b>");
    EXPECT_HAS(page, "Room 0 &amp; friends", "no data", "lambda_d = 0");
    if (const char* folder = std::getenv("SEMFIELD_REPORT_SAMPLES"))
      write_file_atomic(std::string(folder) + "/report_" + std::to_string(runs) + ".html", page);
  }
}

// What exposure and poses of held-out frames cost stands beside the plain figure, where somebody measured it.
TEST(Report, SecondFiguresOfPsnrHaveTheirCards) {
  ReportInput input = sample_input(1);
  EXPECT_LACKS(make_report(input), "colours fitted", "poses fitted");
  input.runs[0].rows.back().set("psnr_fitted_colors", 29.5);
  input.runs[0].rows.back().set("psnr_refined_poses", 28.25);
  EXPECT_HAS(make_report(input), "PSNR, colours fitted", "PSNR, poses fitted", "29.5", "28.2");
}

TEST(Report, SameInputSameBytesAndEveryPartCounts) {
  const ReportInput input = sample_input(2);
  const std::string page = make_report(input);
  EXPECT_TRUE(page == make_report(sample_input(2)));
  ReportInput other = input;
  other.runs[1].rows.back().set("miou", 0.99);
  EXPECT_TRUE(page != make_report(other));
  other = input;
  other.strips[0].images[0].png[60] ^= 1;
  EXPECT_TRUE(page != make_report(other));
}

TEST(Report, BestOfARowIsMarkedByItsDirection) {
  ReportInput input;
  for (const auto& [name, psnr, absrel] : {std::tuple{"a", 30.0, 0.05}, {"b", 20.0, 0.01}}) {
    ReportRun run{.name = name};
    MetricsRow row{.kind = "eval", .split = "test"};
    row.set("psnr", psnr);
    row.set("absrel", absrel);
    run.rows.push_back(row);
    input.runs.push_back(run);
  }
  const std::string page = make_report(input);
  EXPECT_HAS(page, "<td class=\"num best\">30.00</td><td class=\"num\">20.00</td>",
             "<td class=\"num\">0.0500</td><td class=\"num best\">0.0100</td>");
}

TEST(Report, EmptyAndInfiniteRunsStillMakeAPage) {
  ReportInput input;
  input.runs.resize(1);
  EXPECT_EQ(unbalanced(make_report(input)), "");
  MetricsRow row{.kind = "eval"};
  row.set("psnr", std::numeric_limits<double>::infinity());
  row.set("miou", std::nullopt);
  input.runs[0].rows.push_back(row);
  const std::string page = make_report(input);
  EXPECT_EQ(unbalanced(page), "");
  EXPECT_HAS(page, "∞");
  EXPECT_LACKS(page, "nan,", "inf,");
  EXPECT_THROW((void)make_report({}), Error);
}

TEST(ReportInput, IsReadFromRunFolders) {
  const TempDir root;
  std::vector<std::string> folders;
  for (const char* name : {"a/run", "b/run"}) {
    folders.push_back(root / name);
    const RunFolder folder = RunFolder::create(folders.back());
    write_file_atomic(folder.config_path(), "seed: 1\n");
    write_file_atomic(folder.classes_path(),
                      "- {id: 0, name: void, ignore: true}\n- {id: 4, name: wall, color: [1, 2, 3]}\n");
    write_file_atomic(folder.environment_path(), environment_json(this_environment()));
    write_file_atomic(folder.left_out_path(),
                      left_out_json({{"coarse network", "one pass", "1 pass", "B", "25 %", ""}}));
    MetricsLog log = MetricsLog::create(folder.metrics_path());
    for (const MetricsRow& row : sample_run(name, 30, 10, 20).rows) log.append(row);
    const ReportImage image = sample_image("x", 4);
    for (const char* frame : {"0", "1", "2", "3", "4", "5"}) {
      for (const char* kind : {"rgb", "label_vis"})
        write_file_atomic(folder.render_path("test", frame, kind), std::as_bytes(std::span(image.png)));
    }
  }
  write_file_atomic(RunFolder::read(folders[0]).worst_frames_path(),
                    worst_frames_json({{"4", "mIoU 0.10, PSNR 9.0 dB"}, {"0", "mIoU 0.20"}, {"gone", "no pictures"}}));
  const ReportInput input = read_report_input(folders, 2);
  ASSERT_EQ(input.runs.size(), 2u);
  EXPECT_EQ(input.runs[0].name, "run");
  EXPECT_EQ(input.runs[1].name, "b/run");
  EXPECT_EQ(input.split, "test");
  ASSERT_EQ(input.classes.size(), 1u);
  EXPECT_EQ(input.classes[0].color, (std::array<std::uint8_t, 3>{1, 2, 3}));
  const auto names = [](const std::vector<ReportStrip>& strips) {
    std::vector<std::string> out;
    for (const ReportStrip& strip : strips) {
      EXPECT_EQ(strip.images.size(), 2u) << strip.name;
      out.push_back(strip.name);
    }
    return out;
  };
  EXPECT_EQ(names(input.strips), (std::vector<std::string>{"1", "3"})) << "the worst frames are not shown twice";
  EXPECT_EQ(names(input.worst), (std::vector<std::string>{"4", "0"}));
  EXPECT_EQ(input.worst[0].note, "mIoU 0.10, PSNR 9.0 dB");
  EXPECT_EQ(input.runs[0].left_out.size(), 1u);
  // Moved as a whole, the folders give the same page.
  const std::string page = make_report(input);
  fs::rename(root / "a", root / "c");
  EXPECT_TRUE(page == make_report(read_report_input({root / "c/run", folders[1]}, 2)));
  EXPECT_THROW((void)read_report_input({root / "a/run"}), Error);
}

TEST(Html, EscapesAndEncodes) {
  EXPECT_EQ(html_escape("<a href=\"x\">&'"), "&lt;a href=&quot;x&quot;&gt;&amp;&#39;");
  EXPECT_EQ(html_escape(std::string_view("a\0b", 3)),
            "a\xEF\xBF\xBD"
            "b");
  const auto of = [](std::string_view text) {
    return base64({reinterpret_cast<const std::uint8_t*>(text.data()), text.size()});
  };
  EXPECT_EQ(of(""), "");  // the test vectors of RFC 4648, Sec. 10
  EXPECT_EQ(of("f"), "Zg==");
  EXPECT_EQ(of("fo"), "Zm8=");
  EXPECT_EQ(of("foo"), "Zm9v");
  EXPECT_EQ(of("foobar"), "Zm9vYmFy");
}

TEST(Html, FiguresForPeople) {
  EXPECT_EQ(figure_text(31.4159), "31.42");
  EXPECT_EQ(figure_text(0.012345, 3), "0.0123");
  EXPECT_EQ(figure_text(41230, 3), "41230");
  EXPECT_EQ(figure_text(-2.5, 2), "−2.5");
  EXPECT_EQ(figure_text(std::numeric_limits<double>::infinity()), "∞");
}

TEST(Plot, TicksAreRoundAndCoverTheRange) {
  EXPECT_EQ(linear_ticks(0, 95, 5), (std::vector<double>{0, 20, 40, 60, 80, 100}));
  EXPECT_EQ(linear_ticks(12.3, 31.1, 5), (std::vector<double>{10, 15, 20, 25, 30, 35}));
  const std::vector<double> decades = log_ticks(0.009, 11);
  ASSERT_EQ(decades.size(), 4u);
  EXPECT_NEAR(decades[0], 0.01, 1e-12);
  EXPECT_EQ(log_ticks(1, 6).size(), 3u);
}

TEST(Plot, ThinningKeepsMeansAndSkipsWhatCannotBeDrawn) {
  std::vector<PlotPoint> points;
  for (int i = 0; i < 1000; ++i) points.push_back({static_cast<double>(i), 2.0 * i});
  const auto thin = thin_points(points, 10);
  ASSERT_EQ(thin.size(), 10u);
  EXPECT_DOUBLE_EQ(thin[0].x, 49.5);
  EXPECT_DOUBLE_EQ(thin[9].y, 2 * 949.5);
  PlotSpec spec{"loss", "s", true, false, 3, {{"a", 0, {{0, 0}, {1, -1}, {2, std::nan("")}}}}};
  EXPECT_HAS(line_plot(spec), "no data");
  spec.series[0].points.push_back({3, 5});
  const std::string one = line_plot(spec);
  EXPECT_LACKS(one, "nan");
  EXPECT_HAS(one, "<circle");
}

PlotSpec spec_of(std::vector<PlotPoint> points) {
  return {"mIoU", "labels", false, true, 3, {{"a", 0, std::move(points)}}};
}

TEST(Plot, ErrorBarsAreDrawnAndWidenTheRange) {
  EXPECT_EQ(count_of(line_plot(spec_of({{1, 0.5}, {2, 0.6}})), "class=\"eb\""), 0u);
  const std::string bars = line_plot(spec_of({{1, 0.5, 0.1, 0.9}, {2, 0.6, 0.55, std::nullopt}}));
  EXPECT_EQ(count_of(bars, "class=\"eb\""), 3u) << "a stem and two ends for the point that has both";
  EXPECT_HAS(bars, ">0.2</text>") << "the axis reaches the bar's end";
  PlotSpec log = spec_of({{1, 0.5, -0.1, 0.9}, {2, 0.6, 0.5, 0.7}});
  log.log_y = true;
  EXPECT_EQ(count_of(line_plot(log), "class=\"eb\""), 6u) << "an end below a logarithmic axis stops at its foot";
  EXPECT_LACKS(line_plot(log), "nan");
}

TEST(Plot, LogAbscissaHoldsPositivePointsAndRoundTicks) {
  PlotSpec spec = spec_of({{0, 9}, {10, 1}, {100, 2}, {1000, 3}});
  spec.log_x = true;
  const std::string plot = line_plot(spec);
  EXPECT_EQ(count_of(plot, "<circle"), 3u);
  EXPECT_HAS(plot, ">10<", ">100<", ">1000<");
  EXPECT_GE(log_ticks(3000, 4500).size(), 2u) << "a range without 1, 2 or 5 still has ticks";
}

TEST(Plot, BarsMarksAndReferences) {
  PlotSpec spec = spec_of({{0.5, 0.25}, {1, 0.5}});
  spec.series[0].bars = {{0, 0.5, 0.5, "half <b>"}};
  spec.series[0].marks = {
      {0.75, false, "t90"}, {1, true, "t95"}, {0.25, true, "before the line"}, {std::nan(""), true, "nowhere"}};
  spec.series.push_back({"perfect", 0, {{0, 0}, {1, 1}}});
  spec.series.back().reference = true;
  const std::string plot = line_plot(spec);
  EXPECT_HAS(plot, "half &lt;b&gt;");
  EXPECT_EQ(count_of(plot, "class=\"mk\""), 2u) << "marks beyond the line are left out";
  EXPECT_EQ(count_of(plot, "class=\"rf\""), 1u);
  EXPECT_EQ(count_of(plot, "class=\"end\""), 1u) << "the reference has no number";
}

// The report's sections that compare runs and look into their last evaluation, held against hand-made inputs.

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
  EXPECT_HAS(html, ">30.0 s<", ">35.0 s<");
  EXPECT_EQ(count_of(html, "class=\"mk\""), 4u) << "two marks in each of two plots";
  EXPECT_LACKS(html, "log-time") << "10 s to 40 s is less than a decade";
  input.runs[0].rows.insert(input.runs[0].rows.begin(), eval_row(1, 10, 0.1));
  EXPECT_HAS(curves_section(input, "test"), "log-time");
  input.runs[0].rows.resize(1);
  EXPECT_EQ(count_of(curves_section(input, "test"), "class=\"mk\""), 0u) << "one evaluation is no course";
}

TEST(CurvesSection, DrawsEachTermOfTheLossByName) {
  ReportInput input{.runs = {run_named("a")}};
  MetricsRow row{.step = 1, .train_s = 10};
  for (const char* key : {"loss", "loss_color", "loss_semantic", "loss_depth", "loss_distortion"}) row.set(key, 0.5);
  for (row.step = 1; row.step <= 3; ++row.step) input.runs[0].rows.push_back(row);
  const std::string html = curves_section(input, "test");
  EXPECT_HAS(html, "Loss: depth", "Loss: distortion");
  EXPECT_EQ(count_of(html, "<figcaption>Loss: "), 2u) << "colour and semantics are in the training loss";
}

TEST(LabelsSection, ShowsRunsThatKnowTheirLabelsAndNamesTheOthers) {
  ReportInput input{.runs = {run_named("few"), run_named("many"), run_named("<old>")}};
  EXPECT_EQ(labels_section(input, "test"), "") << "no run knows its labels";
  input.runs[0].labels = labels_of(0);
  const std::string table = labels_section(input, "test");
  EXPECT_LACKS(table, "<svg viewBox=\"0 0 540", "nan", "inf") << "one run is a table, no plot";
  input.runs[0].labels = labels_of(4);
  input.runs[1].labels = labels_of(100);
  const std::string html = labels_section(input, "test");
  EXPECT_HAS(html, "4 of 200", "1,920,000", "50 % of all", "2 of 3", "&lt;old&gt;");
  EXPECT_EQ(count_of(html, "<svg viewBox=\"0 0 540"), 4u) << "two metrics over pixels and over frames";
  for (const auto& [run, pixels] : {std::pair{0, 900}, {1, 300}}) input.runs[run].rows.back().set("pixels", pixels);
  EXPECT_LACKS(labels_section(input, "test"), "<svg viewBox=\"0 0 540") << "scored on other pixels";
}

TEST(LabelsSection, SaysWhatWasDoneToLabelsAndWhatTheyWereWorth) {
  ReportInput input{.runs = {run_named("noisy")}};
  input.runs[0].labels = labels_of(4);
  input.runs[0].labels->steps = {{"pixel_noise", {{"pixels changed", "<12>"}, {"share", "0.5"}}}, {"propagate", {}}};
  MetricsRow train{.kind = "eval", .split = "train"};
  train.set("given_miou", 0.345);
  train.set("miou", 0.812);
  input.runs[0].rows.push_back(train);
  EXPECT_HAS(labels_section(input, "test"), "pixel_noise", "propagate", "&lt;12&gt;", ">0.3450<", ">0.8120<");
  EXPECT_EQ(report_split(input.runs[0].rows), "test") << "the page is about held-out frames";
  EXPECT_EQ(report_split({train}), "train");
}

TEST(ConfusionSection, NormalisesRowsAndSaysTheLargest) {
  ReportInput input{.runs = {run_named("a"), run_named("old")}};
  EXPECT_EQ(confusion_section(input), "");
  input.runs[0].eval = eval_of();
  const std::string html = confusion_section(input);
  EXPECT_HAS(html, "75 % of chair &lt;b&gt;", "30 px, 60 %", ">80<", ">75<", "old.");  // of 100 px wall, 40 px chair
  EXPECT_LACKS(html, "<b>");
  EXPECT_EQ(count_of(html, "<th scope=\"row\""), 2u) << "a class that is never true has a column and no row";
  EXPECT_EQ(count_of(html, "class=\"v\""), 3u);
}

TEST(ConfusionSection, KeepsTheLargestOfManyClasses) {
  FinalEval eval;
  constexpr std::size_t kMany = 70;
  eval.confusion.assign(kMany * kMany, 0);
  for (std::size_t c = 0; c < kMany; ++c) {
    eval.classes.push_back({static_cast<std::int32_t>(c), "class" + std::to_string(c), {}});
    eval.confusion[c * kMany + c] = static_cast<std::int64_t>(c + 1);
  }
  ReportInput input{.runs = {run_named("a")}};
  input.runs[0].eval = eval;
  const std::string html = confusion_section(input);
  EXPECT_EQ(count_of(html, "class=\"v\""), 64u);
  EXPECT_LACKS(html, "5 class5<") << "the six with fewest pixels are not shown";
  EXPECT_HAS(html, "6 class6<", "64 of 70");
}

TEST(CalibrationSection, DrawsBinsAndTheirShares) {
  ReportInput input{.runs = {run_named("a")}};
  EXPECT_EQ(calibration_section(input), "");
  input.runs[0].eval = eval_of();
  const std::string html = calibration_section(input);
  EXPECT_HAS(html, "0.0850", "0.035") << "0.25 * 0.1 + 0.75 * 0.08; mean confidence 0.860, accuracy 0.825";
  EXPECT_EQ(count_of(html, "class=\"br\""), 2u);
  EXPECT_EQ(count_of(html, "class=\"rf\""), 1u);
  input.runs[0].eval->nonfinite_px = 1200;
  EXPECT_HAS(calibration_section(input), "no ECE", "1,200");
}

TEST(CalibrationSection, SaysWhatEntropyTellsOfWrongPixelsAndOfTheLabelsGiven) {
  ReportInput input{.runs = {run_named("<a>"), run_named("b")}};
  MetricsRow train{.kind = "eval", .split = "train_sample"};
  train.set("given_right_entropy", 0.125);
  train.set("given_wrong_auroc", 0.875);
  input.runs[0].rows.push_back(train);
  EXPECT_HAS(calibration_section(input), "id=\"calibration\"") << "without held-out frames, training frames";
  input.runs[0].eval = eval_of();
  EXPECT_LACKS(calibration_section(input), "AUROC 0.") << "a file of an earlier version";
  input.runs[0].eval->entropy_auroc = {0.9125, 0.001};
  const std::string html = calibration_section(input);
  EXPECT_HAS(html, "AUROC 0.912", "91 %", "&lt;a&gt;", ">0.125<", ">0.875<");
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
  const TempDir root;
  std::vector<std::string> folders;
  for (const char* name : {"new", "old"}) {
    folders.push_back(root / name);
    const RunFolder folder = RunFolder::create(folders.back());
    write_file_atomic(folder.config_path(), "seed: 1\n");
    MetricsLog log = MetricsLog::create(folder.metrics_path());
    for (const MetricsRow& row : run_named(name).rows) log.append(row);
  }
  const RunFolder fresh = RunFolder::read(folders[0]);
  write_file_atomic(fresh.labels_path(), label_counts_json(labels_of(20)));
  write_file_atomic(fresh.final_eval_path(), final_eval_json(eval_of()));
  const std::string page = make_report(read_report_input(folders));
  for (const char* part : {"id=\"labels\"", "id=\"confusion\"", "id=\"calibration\"", "id=\"worst\""}) {
    EXPECT_HAS(page, part);
    EXPECT_LACKS(make_report(read_report_input({folders[1]})), part);
  }
  EXPECT_TRUE(page == make_report(read_report_input(folders))) << "the same files give the same bytes";
  write_file_atomic(fresh.final_eval_path(), "{\"split\": \"test\"}");
  EXPECT_HAS(error_of([&] { (void)read_report_input(folders); }), "final_eval.json");
}

// A report holds against each other what can be: the same data, the same frames, and only evaluations that were made.

MetricsRow scored_row(double train_s, double psnr, const std::string& split = "test", double frames = 30) {
  MetricsRow row;
  row.kind = "eval";
  row.split = split;
  row.step = static_cast<std::int64_t>(10 * train_s);
  row.train_s = train_s;
  row.set("psnr", psnr);
  row.set("frames", frames);
  if (frames < 30) {
    row.set("split_frames", 30);
    row.set("pixel_stride", 1);
  }
  return row;
}

ReportRun run_of(const std::string& name, std::vector<MetricsRow> rows, const std::string& input_hash = "aa") {
  ReportRun run;
  run.name = name;
  run.rows = std::move(rows);
  run.environment = {
      {"version", "0.1.0"}, {"cpu", "EPYC"}, {"input_hash", input_hash}, {"started", "2026-11-22 15:10 UTC"}};
  run.scene = "obj_room, room";
  return run;
}

// Two samples while training, then the whole split.
std::vector<MetricsRow> long_run() {
  return {scored_row(10, 23.8, "test_sample", 4), scored_row(58.3, 27, "test_sample", 4), scored_row(58.3, 25)};
}

TEST(ReportComparison, TimesAreReadFromEvaluationsThatExist) {
  ReportInput input{.runs = {run_of("long", long_run()), run_of("short", {scored_row(40, 20.58)})}};
  const std::string page = curves_section(input, "test");
  // Of the whole split "long" was scored once, at its end: that it came to the level only then is not known.
  EXPECT_HAS(page, "≥ 20.58 dB", "≤ 58.3 s", "≤ 40.0 s", "4 of 30 frames");
  EXPECT_LACKS(page, "num best") << "neither was first for certain";
  // Two runs with samples of the same frames are compared on these.
  input.runs[1].rows = {scored_row(10, 15, "test_sample", 4), scored_row(40, 20, "test_sample", 4),
                        scored_row(40, 20.58)};
  EXPECT_HAS(curves_section(input, "test"), "≥ 20.00 dB", "num best\">≤ 10.0 s", ">40.0 s<");
}

TEST(ReportComparison, ALevelIsReachedBetweenTwoEvaluations) {
  const std::vector<MetricsRow> rows{scored_row(10, 20), scored_row(20, 24), scored_row(30, 23)};
  const std::vector<const MetricsRow*> all{&rows[0], &rows[1], &rows[2]};
  const auto between = time_of_level(all, "psnr", 1, 23);
  ASSERT_TRUE(between);
  EXPECT_EQ(between->not_before_s, 10);
  EXPECT_EQ(between->not_after_s, 20);
  EXPECT_FALSE(between->at_first);
  EXPECT_TRUE(time_of_level(all, "psnr", 1, 20)->at_first);
  EXPECT_FALSE(time_of_level(all, "psnr", 1, 20)->only);
  EXPECT_TRUE(time_of_level({&rows[0]}, "psnr", 1, 20)->only);
  EXPECT_FALSE(time_of_level(all, "psnr", 1, 25));
  EXPECT_FALSE(time_of_level(all, "miou", 1, 0));
  const LevelTime early{0, 10}, late{10, 20}, overlapping{5, 15};
  EXPECT_EQ(first_for_certain({late, early}), 1);
  EXPECT_EQ(first_for_certain({early, overlapping}), -1);
  EXPECT_EQ(first_for_certain({early, early}), -1);
  EXPECT_EQ(first_for_certain({early, std::nullopt}), -1);
}

TEST(ReportComparison, RunsOnOtherDataAreNotRankedAndThePageSaysWhy) {
  const std::vector<MetricsRow> good{scored_row(10, 20), scored_row(20, 30)}, less{scored_row(20, 25)};
  ReportInput input{.runs = {run_of("a", good), run_of("b", less)}};
  EXPECT_TRUE(unranked_because(input, "test").empty());
  EXPECT_HAS(make_report(input), "best: a");
  input.runs[1] = run_of("b", less, "bb");
  input.runs[1].scene = "replica, <office>";
  const std::string page = make_report(input);
  EXPECT_HAS(page, "class=\"notice\"", "a on obj_room, room", "b on replica, &lt;office&gt;");
  EXPECT_LACKS(page, "num best", "best: ", "Time to a common level");
}

TEST(ReportComparison, RunsScoredOnOtherPixelsOrFramesAreNotRanked) {
  ReportInput input{
      .runs = {run_of("all", {scored_row(20, 30)}), run_of("some", {scored_row(20, 31, "test_sample", 6)})}};
  const auto reasons = [&] { return unranked_because(input, "test"); };
  ASSERT_EQ(reasons().size(), 1u);
  EXPECT_HAS(reasons()[0], "30 frames", "6 of 30");
  EXPECT_LACKS(figures_section(input, "test"), "num best");
  // The same number of frames, but others.
  input.runs[1].rows = {scored_row(20, 31)};
  FrameScore odd, even;
  odd.name = "frame_1";
  even.name = "frame_2";
  input.runs[0].eval.emplace().frames = {odd};
  input.runs[1].eval.emplace().frames = {even};
  ASSERT_EQ(reasons().size(), 1u);
  EXPECT_HAS(reasons()[0], "frame_1");
  input.runs[1].eval->frames = {odd};
  EXPECT_TRUE(reasons().empty());
  input.runs[0].rows[0].set("pixels", 900);
  input.runs[1].rows[0].set("pixels", 300);
  ASSERT_EQ(reasons().size(), 1u);
  EXPECT_HAS(reasons()[0], "900", "300");
}

TEST(ReportComparison, FiguresOfASampleSaySo) {
  ReportInput input{
      .runs = {run_of("short", {scored_row(5, 18, "test_sample", 4), scored_row(6, 21.5, "test_sample", 2)})}};
  EXPECT_EQ(report_split(input.runs[0].rows), "test");
  EXPECT_HAS(make_report(input), "2 of 30 frames", ">21.50<") << "the last evaluation, not that of other frames";
  EXPECT_EQ(sample_text(scored_row(1, 2)), "");
  input.runs[0].rows.push_back(scored_row(6, 20.5));
  EXPECT_HAS(make_report(input), ">20.5<", "all 30 frames");
}

TEST(ReportComparison, FiguresAreThoseOfTheLastEvaluationWhateverItsPart) {
  MetricsRow strided = scored_row(20, 27, "test_sample");
  strided.set("split_frames", 30);
  strided.set("pixel_stride", 7);
  // All of an earlier step, which the run then left.
  const ReportRun run = run_of("a", {scored_row(10, 24), scored_row(15, 20, "test_sample", 4), strided});
  EXPECT_EQ(last_value(run, "test", "psnr"), 27);
  EXPECT_HAS(sample_text(run, "test"), "30 frames", "1 pixel in 49");
}

TEST(ReportHead, TellsSceneFramesDateAndVersion) {
  ReportInput input{.runs = {run_of("a", {scored_row(20, 30)})}};
  input.runs[0].labels = LabelCounts{200, 20, 100, 10, {{1, "wall", 10}}, {}};
  EXPECT_HAS(facts_section(input, "test"), "obj_room, room", "200 training", "20 labelled", "30 test",
             "2026-11-22 15:10 UTC", "0.1.0");
  input.runs = {ReportRun{}};
  EXPECT_EQ(facts_section(input, "test"), "") << "nothing is known";
}

TEST(ReportHead, TheLongestTrainingIsThatOfOneRun) {
  ReportInput input{.runs = {run_of("slow", {scored_row(242, 30)}), run_of("quick", {scored_row(100, 30)})}};
  input.runs[0].rows[0].step = 300;
  input.runs[1].rows[0].step = 2500;
  const std::string cards = cards_section(input, "test");
  EXPECT_HAS(cards, "4 min 02 s", "300 steps");
  EXPECT_LACKS(cards, "2,500");
}

TEST(ReportPage, ASceneWithoutClassesHasNoSectionOfLabels) {
  ReportInput input{.runs = {run_of("photos", {scored_row(20, 30)}), run_of("room", {scored_row(20, 30)})}};
  for (ReportRun& run : input.runs) run.labels.emplace().train_frames = 30;
  EXPECT_EQ(labels_section(input, "test"), "");
  input.runs[1].labels->classes = {{1, "wall", 10}};
  EXPECT_HAS(labels_section(input, "test"), "no classes: photos");
}

TEST(ReportPage, WhatSeveralRunsLeaveOutStandsOnce) {
  ReportInput input{.runs = {run_of("a", {}), run_of("b", {})}};
  const LeftOutRow depth{"depth loss", "no weight", "0", "B", "4 B", ""},
      head{"semantic head", "no labels", "0", "B", "", "3 %"};
  input.runs[0].left_out = {depth, head};
  input.runs[1].left_out = {depth};
  const std::string html = left_out_section(input);
  EXPECT_EQ(count_of(html, "depth loss"), 1u);
  EXPECT_HAS(html, "every run", "semantic head", "3 %");
}

}  // namespace
}  // namespace semfield
