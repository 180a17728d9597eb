// Requests for pictures and exports: what is accepted, what the refusals say, and what exports leave.
#include "app/serve/page_requests.h"

#include <sys/stat.h>
#include <turbojpeg.h>

#include <fstream>
#include <nlohmann/json.hpp>

#include "app/serve/page_pictures.h"
#include "core/error.h"
#include "formats/zip_archive.h"
#include "system/files.h"
#include "tests/says.h"
#include "tests/serve/served_page.h"

namespace semfield::app {
namespace {

using Json = nlohmann::json;
using testing_http::Answer;

std::string refusal(const std::string& json) {
  return error_of(ErrorKind::data, [&] { (void)parse_picture_request(json); });
}

TEST(PictureRequestText, WrongOnesAreNamed) {
  const std::string good_camera = R"({"position":[0,0,0],"rotation":[1,0,0,0,1,0,0,0,1]})";
  const std::vector<std::pair<std::string, std::string>> rows{
      {"[]", "expected a map, got a list of 0"},
      {"{", "not valid JSON"},
      {"{}", "key 'client' is missing"},
      {R"({"client":"c"})", "either 'view' or 'camera'"},
      {R"({"client":"c","view":1,"camera":)" + good_camera + "}", "either 'view' or 'camera'"},
      {R"({"client":"a b","view":1})", "'client': expected"},
      {R"({"client":"c","view":-1})", "'view': expected a whole number from 0"},
      {R"({"client":"c","view":1.5})", "'view': expected"},
      {R"({"client":"c","view":1,"view":2})", "key \"view\" is given twice"},
      {R"({"client":"c","veiw":1})", "did you mean 'view'?"},
      {R"({"client":"c","view":1,"most_px":2049})", "'most_px': expected a whole number from 16 to 2048"},
      {R"({"client":"c","view":1,"color":1})", "'color': expected true or false"},
      {R"({"client":"c","view":1,"labels":false})", "no map is asked for"},
      {R"({"client":"c","view":1,"at":[0,0]})", "'at' is a point of a camera's picture"},
      {R"({"client":"c","at":[0],"camera":)" + good_camera + "}", "'at': expected 2 numbers, got a list of 1"},
      {R"({"client":"c","at":[0,-0.1],"camera":)" + good_camera + "}", "'at': expected shares of width and height"},
      {R"({"client":"c","at":[0,1.1],"camera":)" + good_camera + "}", "'at': expected 2 numbers"},
      {R"({"client":"c","at":[0,1],"labels":true,"camera":)" + good_camera + "}", "'labels' and 'at'"},
      {R"({"client":"c","camera":7})", "'camera': expected a map"},
      {R"({"client":"c","camera":{"position":[0,0,0]}})", "'rotation' is missing"},
      {R"({"client":"c","camera":{"position":[0,0],"rotation":[1,0,0,0,1,0,0,0,1]}})",
       "'position': expected 3 numbers"},
      {R"({"client":"c","camera":{"position":[0,0,1e300],"rotation":[1,0,0,0,1,0,0,0,1]}})", "of a size that a scene"},
      {R"({"client":"c","camera":{"position":[0,0,0],"rotation":[1,0,0,0,1,0,0,0,0.9]}})", "is not a rotation"},
      {R"({"client":"c","camera":{"position":[0,0,0],"rotation":[1,0,0,0,1,0,0,0,-1]}})", "is not a rotation"},
      {R"({"client":"c","camera":{"position":[0,0,0],"rotation":[1,0,0,0,1,0,0,0,1],"fov_deg":171}})",
       "degrees from 1"},
      {R"({"client":"c","camera":{"position":[0,0,0],"position":[0,0,0],"rotation":[1,0,0,0,1,0,0,0,1]}})",
       "given twice"}};
  for (const auto& [json, words] : rows) EXPECT_HAS(refusal(json), words) << json << "\n  " << refusal(json);
}

TEST(PictureRequestText, LabelsAreTheDefault) {
  const PictureRequest r = parse_picture_request(R"({"client":"c-1_","view":3})");
  EXPECT_EQ(r.view, 3);
  EXPECT_TRUE(r.labels);
  EXPECT_FALSE(r.color || r.entropy || r.full || r.camera);
}

TEST(ExportRequestText, KindsHaveNames) {
  for (const ExportKind kind : {ExportKind::labels, ExportKind::coco, ExportKind::mesh})
    EXPECT_EQ(parse_export_request(std::string(R"({"what":")") + export_name(kind) + "\"}").what, kind);
  const ExportRequest end = parse_export_request(R"({"cancel":"coco-1"})");
  EXPECT_FALSE(end.what.has_value());
  EXPECT_EQ(end.cancel, "coco-1");
  for (const char* bad : {"{}", R"({"what":"all"})", R"({"what":1})", R"({"what":"coco","to":"/etc"})", "null",
                          R"({"what":"coco","cancel":"coco-1"})", R"({"cancel":1})", R"({"cancel":"../x"})"})
    EXPECT_THROW((void)parse_export_request(bad), Error) << bad;
}

TEST(QueryNumber, IsWholeAndBounded) {
  EXPECT_EQ(query_number("", "a", 7, 9), 7u);
  EXPECT_EQ(query_number("b=3&a=4", "a", 7, 9), 4u);
  EXPECT_EQ(query_number("aa=3", "a", 7, 9), 7u);
  for (const char* bad : {"a", "a=", "a=x", "a=-1", "a=10", "a=4.5", "a=4%20", "a=+4"})
    EXPECT_THROW((void)query_number(bad, "a", 7, 9), Error) << bad;
}

// Pictures as the page gets them: JPEG, and PNG of labels with transparency.

std::vector<std::uint8_t> decoded(const std::vector<std::uint8_t>& jpeg, int& width, int& height) {
  const tjhandle decoder = tjInitDecompress();
  int sampling = 0, space = 0;
  EXPECT_EQ(tjDecompressHeader3(decoder, jpeg.data(), jpeg.size(), &width, &height, &sampling, &space), 0);
  std::vector<std::uint8_t> rgb(static_cast<std::size_t>(3 * width * height));
  EXPECT_EQ(tjDecompress2(decoder, jpeg.data(), jpeg.size(), rgb.data(), width, 0, height, TJPF_RGB, 0), 0);
  tjDestroy(decoder);
  return rgb;
}

TEST(Jpeg, APictureComesBackNearlyTheSame) {
  for (const auto& [w, h] : {std::pair{1, 1}, {33, 7}, {320, 240}}) {
    std::vector<std::uint8_t> rgb(static_cast<std::size_t>(3 * w * h));
    for (int y = 0; y < h; ++y)
      for (int x = 0; x < w; ++x) {
        std::uint8_t* p = &rgb[3 * (y * w + x)];
        p[0] = static_cast<std::uint8_t>(255 * x / w);
        p[1] = static_cast<std::uint8_t>(255 * y / h);
        p[2] = 60;
      }
    int width = 0, height = 0;
    const std::vector<std::uint8_t> back = decoded(encode_jpeg(w, h, rgb), width, height);
    ASSERT_EQ(width, w);
    ASSERT_EQ(height, h);
    for (std::size_t i = 0; i < rgb.size(); ++i) ASSERT_NEAR(back[i], rgb[i], 24) << w << "x" << h << " at " << i;
  }
}

// Exports run a program beside the training: here a script that notes how it was called.

class Exports : public ServedPage {
 protected:
  // A program of these lines; --out is in $out.
  void serve_with(const std::string& lines) {
    const std::string program = folder_ + "/program";
    std::ofstream(program) << "#!/bin/sh\necho \"$@\" >" << folder_ << "/words\nnice >" << folder_
                           << "/nice\nwhile [ $# -gt 0 ]; do [ \"$1\" = --out ] && out=$2; shift; done\n"
                           << lines << "\n";
    chmod(program.c_str(), 0755);
    PageOptions o = options();
    o.exports = {program, folder_, {"waves.so"}};
    start(o);
  }
  // The list of exports once it is as wanted.
  Json list_when(const std::function<bool(const Json&)>& wanted) const {
    Json s = Json::parse(get("state?after=0").body);
    for (int i = 0; i < 200 && !wanted(s["exports"]); ++i)
      s = Json::parse(get("state?after=" + s["revision"].dump()).body);
    EXPECT_TRUE(wanted(s["exports"])) << s["exports"];
    return s["exports"];
  }
  // The first export in the list once it is made or has failed.
  Json ended() const {
    Json s = Json::parse(get("state?after=0").body);
    const auto is_open = [&] { return s["exports"][0]["state"] == "running" || s["exports"][0]["state"] == "waiting"; };
    for (int i = 0; i < 200 && is_open(); ++i) s = Json::parse(get("state?after=" + s["revision"].dump()).body);
    return s["exports"][0];
  }
};

TEST_F(Exports, LabelsAreRenderedWithLowPriorityAndZipped) {
  serve_with(
      "echo one >$out/a_label.png; echo two >$out/b_label.png; echo no >$out/a_rgb.png; echo chair >$out/classes.yaml");
  const Answer begun = post("export", R"({"what":"labels"})");
  ASSERT_EQ(begun.status, 200) << begun.body;
  EXPECT_EQ(Json::parse(begun.body)["id"], "labels-1");
  const Json done = ended();
  EXPECT_EQ(done["state"], "done") << done;
  EXPECT_EQ(done["files"], Json{"labels.zip"});
  EXPECT_EQ(source_.saves, 1);
  EXPECT_EQ(read_text_file(folder_ + "/words"), "export " + folder_ + " --split train --format png --out " + folder_ +
                                                    "/export/labels-1 --plugin waves.so\n");
  EXPECT_EQ(read_text_file(folder_ + "/nice"), "10\n");
  const Answer file = get("export/labels-1/0");
  EXPECT_EQ(file.status, 200);
  EXPECT_EQ(file.header("content-disposition"), "attachment; filename=\"labels.zip\"");
  std::vector<std::string> names;
  for (const ZipEntry& entry : zip_entries(file.body)) names.push_back(entry.name);
  EXPECT_EQ(names, (std::vector<std::string>{"a_label.png", "b_label.png", "classes.yaml"}));
  EXPECT_HAS(zip_contents(file.body, zip_entries(file.body)[2]), "chair");
  for (const char* none : {"export/labels-1/1", "export/labels-1/-1", "export/labels-1/", "export/labels-1",
                           "export/labels-2/0", "export/../labels-1/0", "export//0", "export/labels-1/00000"})
    EXPECT_EQ(get(none).status, 404) << none;
}

TEST_F(Exports, CocoAndMeshesAreDownloaded) {
  serve_with(
      "case $out in *json) echo '{}' >$out;; *) echo ply >$out; echo glb >${out%ply}glb; echo cls "
      ">${out%.ply}_classes.glb;; esac");
  ASSERT_EQ(post("export", R"({"what":"mesh"})").status, 200);
  EXPECT_EQ(ended()["files"], (Json{"mesh.ply", "mesh.glb", "mesh_classes.ply", "mesh_classes.glb"}));
  EXPECT_EQ(get("export/mesh-1/1").body, "glb\n");
  EXPECT_EQ(get("export/mesh-1/3").body, "cls\n");
  ASSERT_EQ(post("export", R"({"what":"coco"})").status, 200);
  list_when([](const Json& all) { return all[1]["state"] == "done"; });
  EXPECT_EQ(get("export/coco-1/0").body, "{}\n");
}

TEST_F(Exports, TwoAreMadeSideBySideAndTheOthersWaitForTheirTurn) {
  std::filesystem::create_directories(folder_ + "/export/coco-1");  // of an earlier session
  serve_with("until [ -e " + folder_ + "/go ]; do sleep 0.05; done; echo '{}' >$out");
  EXPECT_EQ(Json::parse(post("export", R"({"what":"coco"})").body)["id"], "coco-2")
      << "none takes the place of another";
  ASSERT_EQ(post("export", R"({"what":"mesh"})").status, 200);
  ASSERT_EQ(post("export", R"({"what":"coco"})").status, 200);
  const auto with_state = [](const Json& all, const char* state) {
    return std::count_if(all.begin(), all.end(), [&](const Json& e) { return e["state"] == state; });
  };
  list_when([&](const Json& all) { return with_state(all, "running") == 2 && with_state(all, "waiting") == 1; });
  for (int i = 0; i < 5; ++i) EXPECT_EQ(post("export", R"({"what":"coco"})").status, 200);
  const Answer ninth = post("export", R"({"what":"coco"})");
  EXPECT_EQ(ninth.status, 503);
  EXPECT_NE(Json::parse(ninth.body)["remedy"], "");
  std::ofstream(folder_ + "/go") << "";
  list_when([&](const Json& all) { return with_state(all, "done") == 8; });
}

TEST_F(Exports, OneThatIsMadeOrWaitsCanBeCanceled) {
  serve_with("echo $$ >>" + folder_ + "/pids; exec sleep 600");
  for (int i = 0; i < 3; ++i) ASSERT_EQ(post("export", R"({"what":"coco"})").status, 200);
  for (int i = 0;
       i < 500 && (!std::filesystem::exists(folder_ + "/pids") ||
                   read_text_file(folder_ + "/pids").find('\n') + 1 == read_text_file(folder_ + "/pids").size());
       ++i)
    std::this_thread::sleep_for(std::chrono::milliseconds(20));
  EXPECT_EQ(post("export", R"({"cancel":"coco-3"})").status, 200) << "waits";
  list_when([](const Json& all) { return all[2]["state"] == "canceled"; });
  EXPECT_EQ(post("export", R"({"cancel":"coco-1"})").status, 200);
  const Json all = list_when([](const Json& list) { return list[0]["state"] == "canceled"; });
  EXPECT_EQ(all[1]["state"], "running");
  EXPECT_TRUE(all[0]["files"].empty());
  EXPECT_EQ(post("export", R"({"cancel":"coco-9"})").status, 400);
  EXPECT_EQ(post("export", R"({"cancel":"coco-1"})").status, 200) << "and again";
}

TEST_F(Exports, ProgressIsWhatTheProgramSaidLast) {
  serve_with("echo 'exported 1/9 frames, 0:08 left' >&2; echo 'exported 2/9 frames, 0:07 left' >&2; until [ -e " +
             folder_ + "/go ]; do sleep 0.05; done; echo '{}' >$out");
  ASSERT_EQ(post("export", R"({"what":"coco"})").status, 200);
  list_when([](const Json& all) { return all[0]["text"] == "exported 2/9 frames, 0:07 left"; });
  std::ofstream(folder_ + "/go") << "";
  EXPECT_EQ(ended()["state"], "done");
}

TEST_F(Exports, AFailureSaysWhatTheProgramSaidAndWhereTheRestIs) {
  serve_with("echo 'semfield: no room; free some' >&2; exit 74");
  ASSERT_EQ(post("export", R"({"what":"coco"})").status, 200);
  const Json failed = ended();
  EXPECT_EQ(failed["state"], "failed");
  EXPECT_EQ(failed["text"], "exit code 74: semfield: no room; free some (see " + folder_ + "/export/coco-1/log.txt)");
  EXPECT_TRUE(failed["files"].empty());
  EXPECT_EQ(get("export/coco-1/0").status, 404);
}

TEST_F(Exports, ClosingEndsTheProgram) {
  serve_with("echo $$ >" + folder_ + "/pid; exec sleep 600");
  ASSERT_EQ(post("export", R"({"what":"coco"})").status, 200);
  for (int i = 0; i < 500 && !std::filesystem::exists(folder_ + "/pid"); ++i)
    std::this_thread::sleep_for(std::chrono::milliseconds(20));
  std::this_thread::sleep_for(std::chrono::milliseconds(50));
  const int pid = std::stoi(read_text_file(folder_ + "/pid"));
  server_.reset();
  EXPECT_NE(kill(pid, 0), 0);
}

}  // namespace
}  // namespace semfield::app
