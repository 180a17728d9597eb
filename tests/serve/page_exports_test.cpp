// Exports run a program beside the training: here a script that notes how it was called.
#include <gtest/gtest.h>
#include <sys/stat.h>

#include <chrono>
#include <filesystem>
#include <fstream>
#include <nlohmann/json.hpp>

#include "formats/zip_archive.h"
#include "system/files.h"
#include "tests/serve/served_page.h"

namespace semfield::app {
namespace {

using Json = nlohmann::json;
using testing_http::Answer;

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
  // The first export in the list once it is no longer running.
  Json ended() const {
    Json s = Json::parse(get("state?after=0").body);
    for (int i = 0; i < 200 && s["exports"][0]["state"] == "running"; ++i)
      s = Json::parse(get("state?after=" + s["revision"].dump()).body);
    return s["exports"][0];
  }
};

TEST_F(Exports, LabelsAreRenderedWithLowPriorityAndZipped) {
  serve_with("echo one >$out/a_label.png; echo two >$out/b_label.png; echo no >$out/a_rgb.png");
  const Answer begun = post("export", R"({"what":"labels"})");
  ASSERT_EQ(begun.status, 200) << begun.body;
  EXPECT_EQ(Json::parse(begun.body)["id"], "labels-1");
  const Json done = ended();
  EXPECT_EQ(done["state"], "done") << done;
  EXPECT_EQ(done["files"], Json{"labels.zip"});
  EXPECT_EQ(source_.saves, 1);
  EXPECT_EQ(read_text_file(folder_ + "/words"),
            "render " + folder_ + " --split train --out " + folder_ + "/export/labels-1 --plugin waves.so\n");
  EXPECT_EQ(read_text_file(folder_ + "/nice"), "10\n");
  const Answer file = get("export/labels-1/0");
  EXPECT_EQ(file.status, 200);
  EXPECT_EQ(file.header("content-disposition"), "attachment; filename=\"labels.zip\"");
  std::vector<std::string> names;
  for (const ZipEntry& entry : zip_entries(file.body)) names.push_back(entry.name);
  EXPECT_EQ(names, (std::vector<std::string>{"a_label.png", "b_label.png", "classes.yaml"}));
  EXPECT_NE(zip_contents(file.body, zip_entries(file.body)[2]).find("chair"), std::string::npos);
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
  Json s = Json::parse(get("state?after=0").body);
  while (s["exports"][1]["state"] == "running") s = Json::parse(get("state?after=" + s["revision"].dump()).body);
  EXPECT_EQ(get("export/coco-1/0").body, "{}\n");
}

TEST_F(Exports, OneIsMadeAtATimeAndANewOneNeverReplacesAnOldOne) {
  std::filesystem::create_directories(folder_ + "/export/coco-1");  // of an earlier session
  serve_with("until [ -e " + folder_ + "/go ]; do sleep 0.05; done; echo '{}' >$out");
  EXPECT_EQ(Json::parse(post("export", R"({"what":"coco"})").body)["id"], "coco-2");
  const Answer second = post("export", R"({"what":"mesh"})");
  EXPECT_EQ(second.status, 503);
  EXPECT_NE(Json::parse(second.body)["remedy"], "");
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
