// The report: well-formed, self-contained, byte-identical, escaped; and the plots and text pieces it is made of.
#include "report/report.h"

#include <cstdlib>
#include <filesystem>
#include <tuple>

#include "core/error.h"
#include "eval/image_output.h"
#include "formats/image_io.h"
#include "report/html.h"
#include "report/report_svg.h"
#include "system/files.h"
#include "tests/says.h"

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
  EXPECT_HAS(page, "srcdoc=\"&lt;!doctype html&gt;&lt;p&gt;&quot;A &amp; B&quot;&lt;/p&gt;",
             "script-src 'sha256-ungWv48Bz+pBQUDeXa4iI7ADYaOWF3qctBD/YfIAFa0='",  // of "abc" [FIPS180]
             "href=\"#scene\"");
  EXPECT_LT(page.find("<iframe"), page.find("id=\"frames\""));
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
  std::string root = (fs::temp_directory_path() / "semfield_report_XXXXXX").string();
  ASSERT_NE(::mkdtemp(root.data()), nullptr);
  std::vector<std::string> folders;
  for (const char* name : {"a/run", "b/run"}) {
    const RunFolder folder = RunFolder::create(root + "/" + name);
    write_file_atomic(folder.config_path(), "seed: 1\n");
    write_file_atomic(folder.classes_path(),
                      "- {id: 0, name: void, ignore: true}\n- {id: 4, name: wall, color: [1, 2, 3]}\n");
    write_file_atomic(folder.environment_path(), environment_json(this_environment()));
    write_file_atomic(folder.left_out_path(),
                      left_out_json({{"coarse network", "one pass", "1 pass", "B", "25 %", ""}}));
    MetricsLog log = MetricsLog::create(folder.metrics_path());
    for (const MetricsRow& row : sample_run(name, 30, 10, 20).rows) log.append(row);
    for (const char* frame : {"0", "1", "2", "3", "4", "5"}) {
      const ReportImage image = sample_image("x", 4);
      write_file_atomic(folder.render_path("test", frame, "rgb"), std::as_bytes(std::span(image.png)));
      write_file_atomic(folder.render_path("test", frame, "label_vis"), std::as_bytes(std::span(image.png)));
    }
    folders.push_back(root + "/" + name);
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
  ASSERT_EQ(input.strips.size(), 2u);
  EXPECT_EQ(input.strips[0].name, "1") << "frames of the worst are shown there, not twice";
  EXPECT_EQ(input.strips[1].name, "3");
  ASSERT_EQ(input.worst.size(), 2u);
  EXPECT_EQ(input.worst[0].name, "4");
  EXPECT_EQ(input.worst[0].note, "mIoU 0.10, PSNR 9.0 dB");
  EXPECT_EQ(input.worst[1].images.size(), 2u);
  EXPECT_EQ(input.strips[0].images.size(), 2u);
  EXPECT_EQ(input.runs[0].left_out.size(), 1u);
  // Moved as a whole, the folders give the same page.
  const std::string page = make_report(input);
  fs::rename(root + "/a", root + "/c");
  EXPECT_TRUE(page == make_report(read_report_input({root + "/c/run", folders[1]}, 2)));
  EXPECT_THROW((void)read_report_input({root + "/a/run"}), Error);
  fs::remove_all(root);
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
  EXPECT_EQ(figure_text(0.85), "0.8500");
  EXPECT_EQ(figure_text(0), "0.000");
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
  const std::string plain = line_plot(spec_of({{1, 0.5}, {2, 0.6}}));
  EXPECT_EQ(count_of(plain, "class=\"eb\""), 0u);
  const std::string bars = line_plot(spec_of({{1, 0.5, 0.1, 0.9}, {2, 0.6, 0.55, std::nullopt}}));
  EXPECT_EQ(count_of(bars, "class=\"eb\""), 3u) << "a stem and two ends for the point that has both";
  EXPECT_HAS(bars, "0.500 (0.100 to 0.900) at 1.00");
  EXPECT_HAS(bars, ">0.2</text>") << "the axis reaches the bar's end";
  PlotSpec log = spec_of({{1, 0.5, -0.1, 0.9}, {2, 0.6, 0.5, 0.7}});
  log.log_y = true;
  const std::string on_log = line_plot(log);
  EXPECT_EQ(count_of(on_log, "class=\"eb\""), 6u) << "an end below a logarithmic axis stops at its foot";
  EXPECT_LACKS(on_log, "nan");
}

TEST(Plot, LogAbscissaHoldsPositivePointsAndRoundTicks) {
  PlotSpec spec = spec_of({{0, 9}, {10, 1}, {100, 2}, {1000, 3}});
  spec.log_x = true;
  const std::string plot = line_plot(spec);
  EXPECT_EQ(count_of(plot, "<circle"), 3u);
  EXPECT_HAS(plot, "points=\"54.0,");
  EXPECT_HAS(plot, " 264.0,") << "the middle decade stands in the middle: 54 + 420 / 2";
  EXPECT_HAS(plot, ">10<", ">100<", ">1000<");
  spec.series[0].points = {{614400, 0.5}};
  EXPECT_HAS(line_plot(spec), ">1M<");
  EXPECT_GE(log_ticks(3000, 4500).size(), 2u) << "a range without 1, 2 or 5 still has ticks";
}

TEST(Plot, BarsMarksAndReferences) {
  PlotSpec spec = spec_of({{0.5, 0.25}, {1, 0.5}});
  spec.x_range = spec.y_range = PlotRange{0, 1};
  spec.series[0].bars = {{0, 0.5, 0.5, "half <b>"}};
  spec.series[0].marks = {
      {0.75, false, "t90"}, {1, true, "t95"}, {0.25, true, "before the line"}, {std::nan(""), true, "nowhere"}};
  spec.series.push_back({"perfect", 0, {{0, 0}, {1, 1}}});
  spec.series.back().reference = true;
  const std::string plot = line_plot(spec);
  EXPECT_HAS(plot, "<rect class=\"br\" x=\"55.0\" y=\"129.0\" width=\"208.0\" height=\"115.0\"", "half &lt;b&gt;");
  EXPECT_EQ(count_of(plot, "class=\"mk\""), 2u);
  EXPECT_HAS(plot, "<circle cx=\"369.0\" cy=\"157.8\" r=\"5.5\" class=\"mk\"")
      << "half way between the two points: 54 + 0.75 * 420, 244 - 0.375 * 230";
  EXPECT_EQ(count_of(plot, "class=\"rf\""), 1u);
  EXPECT_EQ(count_of(plot, "class=\"end\""), 1u) << "the reference has no number";
  EXPECT_EQ(unbalanced(plot), "");
}

}  // namespace
}  // namespace semfield
