while true do
    h3c.dOut(17, 1) -- coloca a saída em nível alto
    o3c.dms(1)      -- aguarda 1ms
    h3c.dOut(17, 0) -- coloca a saída em nível baixo
    o3c.dms(1)      -- aguarda 1 ms
end
