#include "app/serve/page_access.h"

#include <arpa/inet.h>
#include <fcntl.h>
#include <sys/random.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cctype>
#include <cerrno>
#include <cstdint>

#include "core/error.h"
#include "system/files.h"

namespace semfield::app {

namespace {

constexpr const char* kEveryAddress = "0.0.0.0";

HttpResponse forbidden(const std::string& why) { return {403, "text/plain", why + "\n"}; }

bool is_ipv4(const std::string& text) {
  in_addr number{};
  return inet_pton(AF_INET, text.c_str(), &number) == 1;
}

}  // namespace

std::string new_token() {
  std::array<std::uint8_t, 16> bits{};
  if (getrandom(bits.data(), bits.size(), 0) != static_cast<ssize_t>(bits.size()))
    throw Error(ErrorKind::unavailable, "system.random.missing",
                "the system gives no random bits for the page's secret address",
                "see `man 2 getrandom`; a kernel from 3.17 on has it");
  std::string token;
  for (const std::uint8_t b : bits) {
    token += "0123456789abcdef"[b >> 4];
    token += "0123456789abcdef"[b & 15];
  }
  return token;
}

std::string kept_token(const std::string& run_dir) {
  const std::string path = run_dir + "/serve_token";
  struct stat facts {};
  if (lstat(path.c_str(), &facts) == 0 && S_ISREG(facts.st_mode) && (facts.st_mode & 077) == 0 &&
      facts.st_uid == geteuid()) {
    const std::string kept = read_text_file(path);
    if (kept.size() == 32 && kept.find_first_not_of("0123456789abcdef") == std::string::npos) return kept;
  }
  unlink(path.c_str());
  const int file = open(path.c_str(), O_WRONLY | O_CREAT | O_EXCL | O_CLOEXEC | O_NOFOLLOW, 0600);
  if (file < 0) throw write_error("create", path, errno);
  const std::string token = new_token();
  try {
    append_all(file, path, token);
  } catch (...) {
    close(file);
    throw;
  }
  close(file);
  return token;
}

PageAccess::PageAccess(std::string token, std::string address, int port)
    : token_(std::move(token)), address_(std::move(address)), port_(port) {}

std::string PageAccess::url() const {
  return "http://" + (address_ == kEveryAddress ? "127.0.0.1" : address_) + ":" + std::to_string(port_) + "/" + token_ +
         "/";
}

// Takes the same time for every wrong token, so that none can be found byte by byte.
bool PageAccess::is_token(const std::string& path) const {
  if (path.size() < token_.size() + 1 || path[0] != '/') return false;
  unsigned differs = 0;
  for (std::size_t i = 0; i < token_.size(); ++i)
    differs |= static_cast<unsigned char>(path[i + 1]) ^ static_cast<unsigned char>(token_[i]);
  return differs == 0 && (path.size() == token_.size() + 1 || path[token_.size() + 1] == '/');
}

// A name of somebody else that is made to point here (DNS rebinding) is no host of ours. A server of every address
// has many, but all are numbers.
bool PageAccess::is_host(const std::string& host) const {
  const std::size_t colon = host.rfind(':');
  if (colon == std::string::npos || host.substr(colon + 1) != std::to_string(port_)) return false;
  std::string name = host.substr(0, colon);
  std::transform(name.begin(), name.end(), name.begin(),
                 [](unsigned char c) { return static_cast<char>(std::tolower(c)); });
  return name == "127.0.0.1" || name == "localhost" || name == address_ || (address_ == kEveryAddress && is_ipv4(name));
}

std::optional<HttpResponse> PageAccess::refuse(const HttpRequest& head) const {
  if (!is_token(head.path)) return HttpResponse{404, "text/plain", "not found\n"};
  const std::string host = head.header("host").value_or("");
  if (head.header_count("host") != 1 || !is_host(host))
    return forbidden("the page is at " + address_ + ":" + std::to_string(port_) +
                     " alone; a tunnel has to lead there from the same port (ssh -L " + std::to_string(port_) +
                     ":127.0.0.1:" + std::to_string(port_) + " ...)");
  if (const auto origin = head.header("origin"); head.method == "POST" && origin && *origin != "http://" + host)
    return forbidden("a page of another origin may not send");
  const std::string site = head.header("sec-fetch-site").value_or("none");
  // A link that leads here from another page opens the page; it can neither read nor send.
  const bool opens = head.method == "GET" && head.header("sec-fetch-mode") == "navigate" &&
                     head.header("sec-fetch-dest") == "document";
  if (site != "none" && site != "same-origin" && !opens) return forbidden("a page of another site may not ask");
  if (head.path.size() == token_.size() + 1) {  // without the folder's slash relative addresses would leave it
    HttpResponse onward{308, "text/plain", ""};
    onward.location = head.path + "/";
    return onward;
  }
  return std::nullopt;
}

}  // namespace semfield::app
