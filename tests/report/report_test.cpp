// What a report reads from run folders, and the page around it. report_page_test.py looks at the page in a browser.
#include "eval/report/report.h"

#include <nlohmann/json.hpp>

#include "eval/final_eval.h"
#include "formats/image_io.h"
#include "labels/labelling_record.h"
#include "tests/says.h"
#include "tests/temp_dir.h"
#include "train/metrics_log.h"

namespace semfield {
namespace {

using Json = nlohmann::ordered_json;

// A run folder with three training rows and an evaluation of each split.
RunFolder make_run(const std::string& path) {
  RunFolder folder = RunFolder::create(path);
  write_file_atomic(folder.config_path(), "scene: {type: packed, file: scenes/room.sfpack}\n# </script><b>\n");
  MetricsLog log = MetricsLog::resume(folder.metrics_path(), 0);
  for (std::int64_t step = 1; step <= 3; ++step) {
    MetricsRow row{.step = step, .train_s = 0.5 * static_cast<double>(step)};
    row.set("loss", 0.1);
    row.set("rays_per_s", 1000);
    log.append(row);
  }
  MetricsRow eval{.kind = "eval", .step = 3, .train_s = 1.5, .split = "test_sample"};
  eval.set("psnr", std::numeric_limits<double>::infinity());
  log.append(eval);
  log.append({.kind = "eval", .step = 3, .train_s = 1.5, .split = "train"});
  return folder;
}

void write_pictures(const RunFolder& folder, const char* split, std::initializer_list<const char*> frames) {
  const std::vector<std::uint8_t> png = encode_png(1, 1, 2, 8, std::vector<std::uint8_t>{1, 2, 3});
  for (const char* frame : frames)
    for (const char* kind : {"rgb", "label_vis"})
      write_file_atomic(folder.render_path(split, frame, kind), std::as_bytes(std::span(png)));
}

std::vector<std::string> names_of(const Json& list) {
  std::vector<std::string> names;
  for (const Json& one : list) names.push_back(one["name"]);
  return names;
}

TEST(ReportInput, IsReadFromRunFolders) {
  const TempDir root;
  for (const char* name : {"a/run", "b/run"}) (void)make_run(root / name);
  const RunFolder first = RunFolder::read(root / "a/run");
  write_pictures(first, "test", {"0", "1", "2", "3", "4", "5"});
  write_file_atomic(first.classes_path(),
                    "- {id: 0, name: void, ignore: true}\n- {id: 4, name: wall, color: [1, 2, 3]}\n");
  write_file_atomic(first.environment_path(), "{\"cpu\": \"A & B\", \"modules\": [\"x 1\", \"y 2\"]}");
  write_file_atomic(first.left_out_path(),
                    left_out_json({{"coarse network", "one pass", "1 pass", ProofClass::bitwise, "25 %"}}));
  write_file_atomic(first.worst_frames_path(), R"([{"frame": "4", "score": "mIoU 0.10"}, {"frame": "0", "score": ""},
                                                   {"frame": "gone", "score": "no pictures"}])");
  const SceneManifest manifest{
      .classes = 1, .train_class_pixels = {40}, .train_pixels = 100, .train_frames = 10, .labelled_frames = 4};
  write_file_atomic(first.labels_path(),
                    label_counts_json(manifest, ClassTable({{4, "wall", {}, false}}),
                                      {{"pixel_noise", {{"pixels", "12"}}}}, {{45, 60, 30, 0, 0}}));
  const std::vector<std::string> folders{root / "a/run", root / "b/run"};
  const std::string text = read_report(folders, 2);
  const Json data = Json::parse(text);
  EXPECT_EQ(names_of(data["runs"]), (std::vector<std::string>{"run", "b/run"}));
  EXPECT_EQ(data["split"], "test") << "the page is about held-out frames";
  EXPECT_EQ(data["classes"], Json::parse(R"([{"name": "wall", "color": [1, 2, 3]}])"));
  EXPECT_EQ(names_of(data["strips"]), (std::vector<std::string>{"1", "3"})) << "the worst frames are not shown twice";
  EXPECT_EQ(names_of(data["worst"]), (std::vector<std::string>{"4", "0"}));
  EXPECT_EQ(data["worst"][0]["note"], "mIoU 0.10");
  EXPECT_EQ(data["worst"][0]["images"].size(), 2u);
  const Json& run = data["runs"][0];
  EXPECT_EQ(run["scene"], "packed, room.sfpack");
  EXPECT_EQ(run["environment"], Json::parse(R"([["cpu", "A & B"], ["modules", "x 1, y 2"]])"));
  EXPECT_EQ(run["left_out"][0]["component"], "coarse network");
  EXPECT_EQ(run["labels"]["labelled_frames"], 4);
  EXPECT_EQ(run["rounds"].size(), 1u);
  ASSERT_EQ(run["rows"].size(), 5u);
  EXPECT_FALSE(run["rows"][0].contains("rays_per_s"));
  EXPECT_EQ(run["rows"][2]["rays_per_s"], 1000) << "of the last training row";
  EXPECT_EQ(run["rows"][3]["psnr"], "inf");
  EXPECT_TRUE(data["runs"][1]["labels"].is_null() && data["runs"][1]["eval"].is_null());
  // Moved as a whole, the folders give the same page.
  fs::rename(root / "a", root / "c");
  EXPECT_EQ(text, read_report({root / "c/run", folders[1]}, 2));
  EXPECT_THROW((void)read_report({folders[0]}), Error);
  EXPECT_ERROR(read_report({}), "usage.word.missing");
}

TEST(ReportInput, DamagedFilesAreNamed) {
  const TempDir root;
  const RunFolder folder = make_run(root / "run");
  const std::pair<std::string, std::string> bad[] = {{folder.final_eval_path(), "{\"split\": \"test\"}"},
                                                     {folder.worst_frames_path(), "[{\"frame\": 3}]"},
                                                     {folder.left_out_path(), "{}"},
                                                     {folder.labels_path(), "{}"},
                                                     {folder.labelling_path(), "{}"}};
  for (const auto& [path, text] : bad) {
    write_file_atomic(path, text);
    EXPECT_ERROR(read_report({root / "run"}), "run.record.damaged", fs::path(path).filename().string());
    fs::remove(path);
  }
}

TEST(ReportPage, StandsAloneAndRunsItsOwnScriptsAlone) {
  const TempDir root;
  (void)make_run(root / "run");
  const std::string data = read_report({root / "run"});
  const std::string page = report_page(data);
  EXPECT_LACKS(page, "src=\"/", "url(", "@import", "<link", "https://", "</script><b>");
  EXPECT_HAS(page, "default-src 'none'", "script-src 'sha256-", "\\u003c/script>");
  EXPECT_EQ(page, report_page(data)) << "the same files give the same bytes";
  const std::string scene =
      "<!doctype html><p>\"A & B\"</p><script type=\"text/plain\">no</script><script>abc</script>";
  EXPECT_HAS(report_page(data, scene), " 'sha256-ungWv48Bz+pBQUDeXa4iI7ADYaOWF3qctBD/YfIAFa0='");  // "abc" [FIPS180]
}

TEST(Html, EscapesEncodesAndFills) {
  EXPECT_EQ(html_escape("<a href=\"x\">&'"), "&lt;a href=&quot;x&quot;&gt;&amp;&#39;");
  EXPECT_EQ(html_escape(std::string_view("a\0b", 3)),
            "a\xEF\xBF\xBD"
            "b");
  const auto of = [](std::string_view text) {
    return base64({reinterpret_cast<const std::uint8_t*>(text.data()), text.size()});
  };
  // The test vectors of RFC 4648, Sec. 10.
  for (const auto& [text, code] :
       {std::pair{"", ""}, {"f", "Zg=="}, {"fo", "Zm8="}, {"foo", "Zm9v"}, {"foobar", "Zm9vYmFy"}})
    EXPECT_EQ(of(text), code);
  EXPECT_EQ(filled_page("a/*x*/b/*y*/", {{"/*x*/", "/*y*/"}, {"/*y*/", "2"}}), "a/*y*/b2")
      << "what fills is not filled";
  EXPECT_ERROR(filled_page("a", {{"/*x*/", ""}}), "files.shared.missing", "/*x*/");
}

TEST(LabellingRecord, IsReadAsItWasWrittenAndStrictly) {
  const LabellingRecord record{
      900,         17, 3, 20, {{1, "wa<ll", {10, 20, 30}, 12, 0.4, 0.93}, {7, "cup", {200, 0, 0}, 5, 0.0004, 0.5}},
      {{"f/2", 9}}};
  const std::string json = labelling_record_json(record);
  EXPECT_EQ(parse_labelling_record(json, "x"), record);
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

}  // namespace
}  // namespace semfield
