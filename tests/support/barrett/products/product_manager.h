#pragma once
#include <functional>

namespace barrett {

class SafetyModule {
public:
    enum Mode { IDLE };
    std::function<void()> wait;
    void waitForMode(Mode) { wait(); }
};

class ProductManager {
public:
    SafetyModule safety;
    SafetyModule* getSafetyModule() { return &safety; }
};

}  // namespace barrett
